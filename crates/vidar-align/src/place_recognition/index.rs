//! Exhaustive search for places that look alike and are far apart in time.

use vidar_core::{FrameId, Timestamp};

/// Descriptors of a run, 2 bytes per number, and where on the way they were taken.
#[derive(Clone, Debug, Default)]
pub struct PlaceIndex {
    dimension: usize,
    /// Row-major, in units of each row's `step`.
    values: Vec<i16>,
    places: Vec<Place>,
    /// How places look on average; none where descriptors are compared as they are.
    common: Option<Common>,
}

/// How much a row of the index, in units of its step, looks like what is searched for.
type Likeness<'a> = Box<dyn Fn(&[i16], f32) -> f32 + 'a>;

/// Sums over all places, channel by channel.
#[derive(Clone, Debug, Default)]
struct Common {
    sum: Vec<f64>,
    squares: Vec<f64>,
}

/// Before so many places their average says nothing.
const FEW_PLACES: usize = 16;
/// Channels that vary less than this share of the average channel are not blown up further.
const LEAST_VARIANCE: f64 = 0.01;

#[derive(Clone, Copy, Debug)]
struct Place {
    frame_id: FrameId,
    time: Timestamp,
    travel_m: f64,
    step: f32,
}

/// A place that looks alike.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlaceMatch {
    /// The frame taken there.
    pub frame_id: FrameId,
    /// Inner product of the descriptors.
    pub similarity: f32,
}

impl PlaceIndex {
    /// An index for descriptors that are all alike, as averaged tokens are: similarity is the correlation of what sets two
    /// places apart from the average of all so far, each channel in units of its spread (a diagonal whitening). Until
    /// there are some places nothing is found.
    pub fn whitened() -> Self {
        Self { common: Some(Common::default()), ..Self::default() }
    }

    /// Whether the average look is removed before places are compared.
    pub fn is_whitened(&self) -> bool {
        self.common.is_some()
    }

    /// Number of places.
    pub fn len(&self) -> usize {
        self.places.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.places.is_empty()
    }

    /// Bytes held.
    pub fn memory_bytes(&self) -> usize {
        self.values.len() * 2 + self.places.len() * size_of::<Place>()
    }

    /// Adds a place. A descriptor of another length than the first, or one that is not finite, is not taken: `false`.
    ///
    /// `travel_m` is the length of the way so far.
    pub fn add(&mut self, frame_id: FrameId, time: Timestamp, travel_m: f64, descriptor: &[f32]) -> bool {
        if self.places.is_empty() {
            self.dimension = descriptor.len();
        }
        let finite = descriptor.iter().all(|v| v.is_finite());
        if descriptor.is_empty() || descriptor.len() != self.dimension || !finite {
            return false;
        }
        // 15 bits of the largest entry: an inner product is off by less than 1e-4.
        let largest = descriptor.iter().fold(0.0_f32, |a, v| a.max(v.abs())).max(f32::MIN_POSITIVE);
        let step = largest / f32::from(i16::MAX);
        if let Some(common) = &mut self.common {
            common.add(descriptor);
        }
        self.values.extend(descriptor.iter().map(|v| (v / step).round() as i16));
        self.places.push(Place { frame_id, time, travel_m, step });
        true
    }

    /// The `top_k` most similar places that lie `min_gap_s` and `min_travel_m` or more before this one, best first.
    ///
    /// Places near in time are left out before the best are chosen: in slow or fast-sampled video they would fill every
    /// list, and no revisit would ever be seen.
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
        let far = |p: &Place| {
            time.since(p.time).as_secs_f64() >= min_gap_s && travel_m - p.travel_m >= min_travel_m
        };
        let likeness: Likeness<'_> = match &self.common {
            None => Box::new(|row, step| inner(row, descriptor) * step),
            Some(_) if self.len() < FEW_PLACES => return Vec::new(),
            Some(common) => common.correlation(self.len(), descriptor),
        };
        let rows = self.places.iter().zip(self.values.chunks_exact(self.dimension));
        let mut found: Vec<PlaceMatch> = rows
            .filter(|(p, _)| far(p))
            .map(|(p, row)| PlaceMatch { frame_id: p.frame_id, similarity: likeness(row, p.step) })
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

impl Common {
    fn add(&mut self, descriptor: &[f32]) {
        self.sum.resize(descriptor.len(), 0.0);
        self.squares.resize(descriptor.len(), 0.0);
        for ((sum, square), v) in self.sum.iter_mut().zip(&mut self.squares).zip(descriptor) {
            *sum += f64::from(*v);
            *square += f64::from(*v).powi(2);
        }
    }

    /// Of a descriptor with a row of the index: both less the mean, each channel weighed by the inverse of its variance.
    fn correlation(&self, places: usize, descriptor: &[f32]) -> Likeness<'static> {
        let n = places as f64;
        let mean: Vec<f64> = self.sum.iter().map(|s| s / n).collect();
        let variance: Vec<f64> =
            self.squares.iter().zip(&mean).map(|(s, m)| (s / n - m * m).max(0.0)).collect();
        let floor = LEAST_VARIANCE * variance.iter().sum::<f64>() / variance.len().max(1) as f64;
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

/// Summed in sixteen lanes, so that the compiler may use vector registers; always in the same order.
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
