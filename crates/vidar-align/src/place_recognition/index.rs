//! Exhaustive search for images with similar descriptors that are far apart in time.

use vidar_core::{FrameId, Timestamp};

/// Descriptors of a run, 2 bytes per entry, with the time and the travelled distance of each image.
#[derive(Clone, Debug, Default)]
pub struct PlaceIndex {
    dimension: usize,
    /// Row-major, in units of each row's `step`.
    values: Vec<i16>,
    images: Vec<IndexedImage>,
    /// Statistics for whitening; none where descriptors are compared as they are.
    statistics: Option<ChannelStatistics>,
}

/// Similarity of a row of the index, in units of its step, to the query.
type Similarity<'a> = Box<dyn Fn(&[i16], f32) -> f32 + 'a>;

/// Sums over all images, channel by channel.
#[derive(Clone, Debug, Default)]
struct ChannelStatistics {
    sum: Vec<f64>,
    squares: Vec<f64>,
}

/// Fewer images than this do not give a useful mean.
const MIN_IMAGES: usize = 16;
/// Added to each channel's variance, as a share of the mean variance of all channels.
const VARIANCE_FLOOR: f64 = 0.01;

#[derive(Clone, Copy, Debug)]
struct IndexedImage {
    frame_id: FrameId,
    time: Timestamp,
    travel_m: f64,
    step: f32,
}

/// A similar image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlaceMatch {
    /// Its frame.
    pub frame_id: FrameId,
    /// Inner product of the descriptors.
    pub similarity: f32,
}

impl PlaceIndex {
    /// An index for descriptors with a large common part, such as mean tokens. Similarity is the correlation of two
    /// descriptors after subtracting the mean of all descriptors so far and dividing each channel by its standard deviation
    /// (diagonal whitening). A search among fewer than 16 images finds nothing.
    pub fn whitened() -> Self {
        Self { statistics: Some(ChannelStatistics::default()), ..Self::default() }
    }

    /// Whether descriptors are whitened before they are compared.
    pub fn is_whitened(&self) -> bool {
        self.statistics.is_some()
    }

    /// Number of images.
    pub fn len(&self) -> usize {
        self.images.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.images.is_empty()
    }

    /// Bytes held.
    pub fn memory_bytes(&self) -> usize {
        self.values.len() * 2 + self.images.len() * size_of::<IndexedImage>()
    }

    /// Adds an image; `false` for a descriptor that is not finite or not as long as the first one.
    ///
    /// `travel_m` is the distance travelled so far.
    pub fn add(&mut self, frame_id: FrameId, time: Timestamp, travel_m: f64, descriptor: &[f32]) -> bool {
        if self.images.is_empty() {
            self.dimension = descriptor.len();
        }
        let finite = descriptor.iter().all(|v| v.is_finite());
        if descriptor.is_empty() || descriptor.len() != self.dimension || !finite {
            return false;
        }
        // 15 bits of the largest entry: an inner product is off by less than 1e-4.
        let largest = descriptor.iter().fold(0.0_f32, |a, v| a.max(v.abs())).max(f32::MIN_POSITIVE);
        let step = largest / f32::from(i16::MAX);
        if let Some(statistics) = &mut self.statistics {
            statistics.add(descriptor);
        }
        self.values.extend(descriptor.iter().map(|v| (v / step).round() as i16));
        self.images.push(IndexedImage { frame_id, time, travel_m, step });
        true
    }

    /// The `top_k` most similar images at least `min_gap_s` and `min_travel_m` before this one, best first.
    ///
    /// Images near in time are excluded before the best are chosen: in slow or densely sampled video they would fill every
    /// list and hide revisits.
    pub fn search(
        &self,
        time: Timestamp,
        travel_m: f64,
        descriptor: &[f32],
        top_k: usize,
        min_gap_s: f64,
        min_travel_m: f64,
    ) -> Vec<PlaceMatch> {
        if descriptor.len() != self.dimension || self.dimension == 0 {
            return Vec::new();
        }
        let far = |p: &IndexedImage| {
            time.since(p.time).as_secs_f64() >= min_gap_s && travel_m - p.travel_m >= min_travel_m
        };
        let similarity_of: Similarity<'_> = match &self.statistics {
            None => Box::new(|row, step| inner(row, descriptor) * step),
            Some(_) if self.len() < MIN_IMAGES => return Vec::new(),
            Some(statistics) => statistics.correlation(self.len(), descriptor),
        };
        let rows = self.images.iter().zip(self.values.chunks_exact(self.dimension));
        let mut found: Vec<PlaceMatch> = rows
            .filter(|(image, _)| far(image))
            .map(|(p, row)| PlaceMatch { frame_id: p.frame_id, similarity: similarity_of(row, p.step) })
            .filter(|m| m.similarity.is_finite())
            .collect();
        let order = |a: &PlaceMatch, b: &PlaceMatch| {
            b.similarity.total_cmp(&a.similarity).then(a.frame_id.cmp(&b.frame_id))
        };
        if found.len() > top_k && top_k > 0 {
            found.select_nth_unstable_by(top_k - 1, order);
        }
        found.truncate(top_k);
        found.sort_unstable_by(order);
        found
    }
}

impl ChannelStatistics {
    fn add(&mut self, descriptor: &[f32]) {
        self.sum.resize(descriptor.len(), 0.0);
        self.squares.resize(descriptor.len(), 0.0);
        for ((sum, square), v) in self.sum.iter_mut().zip(&mut self.squares).zip(descriptor) {
            *sum += f64::from(*v);
            *square += f64::from(*v).powi(2);
        }
    }

    /// Correlation of a descriptor with a row of the index: both less the mean, each channel weighted by its inverse variance.
    fn correlation(&self, images: usize, descriptor: &[f32]) -> Similarity<'static> {
        let n = images as f64;
        let mean: Vec<f64> = self.sum.iter().map(|s| s / n).collect();
        let variance: Vec<f64> =
            self.squares.iter().zip(&mean).map(|(s, m)| (s / n - m * m).max(0.0)).collect();
        let floor = VARIANCE_FLOOR * variance.iter().sum::<f64>() / variance.len().max(1) as f64;
        let weight: Vec<f32> = variance.iter().map(|v| (1.0 / (v + floor).max(1e-30)) as f32).collect();
        let mean: Vec<f32> = mean.into_iter().map(|m| m as f32).collect();
        let own: Vec<f32> = descriptor.iter().zip(&mean).map(|(d, m)| d - m).collect();
        let length = own.iter().zip(&weight).map(|(d, w)| d * d * w).sum::<f32>().sqrt();
        Box::new(move |row, step| {
            let (mut product, mut square) = (0.0_f32, 0.0_f32);
            for (((r, m), w), d) in row.iter().zip(&mean).zip(&weight).zip(&own) {
                let other = f32::from(*r) * step - m;
                product += other * w * d;
                square += other * w * other;
            }
            product / (length * square.sqrt()).max(1e-30)
        })
    }
}

/// Inner product in sixteen lanes, which the compiler vectorises; the order of summation is fixed.
fn inner(a: &[i16], b: &[f32]) -> f32 {
    const LANES: usize = 16;
    let mut lanes = [0.0_f32; LANES];
    let (a_chunks, b_chunks) = (a.chunks_exact(LANES), b.chunks_exact(LANES));
    let rest: f32 =
        a_chunks.remainder().iter().zip(b_chunks.remainder()).map(|(x, y)| f32::from(*x) * y).sum();
    for (x, y) in a_chunks.zip(b_chunks) {
        for lane in 0..LANES {
            lanes[lane] += f32::from(x[lane]) * y[lane];
        }
    }
    lanes.iter().sum::<f32>() + rest
}
