//! Resamples maps of the network to the size of the image.

use nalgebra::Matrix3;
use vidar_core::Image;
use vidar_da3::preprocess::{PreprocessConfig, Step, follow, plan};

/// Neighbouring depths that differ by more than this factor belong to two surfaces: values are not interpolated between them.
const EDGE_RATIO: f32 = 1.1;

/// Mapping of image pixels to processed pixels: `processed = scale · image + offset`, both from the edge of the top-left pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Mapping {
    scale: (f64, f64),
    offset: (f64, f64),
}

impl Mapping {
    /// The mapping of an image of `width` × `height` into maps of `processed` columns and rows.
    pub fn new(
        (width, height): (usize, usize),
        processed: (usize, usize),
        config: &PreprocessConfig,
    ) -> Result<Self, vidar_da3::Da3Error> {
        let mut size = (width, height);
        let mut matrix = Matrix3::identity();
        for step in plan(width, height, config)? {
            matrix = follow(&matrix, size, step);
            size = match step {
                Step::Resize { width, height, .. } | Step::Crop { width, height, .. } => (width, height),
            };
        }
        // A batch of several shapes is cut to the smallest about the centre.
        let crop = |from: usize, to: usize| (from.saturating_sub(to) / 2) as f64;
        let offset = (matrix[(0, 2)] - crop(size.0, processed.0), matrix[(1, 2)] - crop(size.1, processed.1));
        Ok(Self { scale: (matrix[(0, 0)], matrix[(1, 1)]), offset })
    }

    /// Processed pixels per pixel of the image, both ways averaged.
    pub fn mean_scale(&self) -> f64 {
        0.5 * (self.scale.0 + self.scale.1)
    }

    /// A camera matrix of the maps as one of the image.
    pub fn intrinsics_of_image(&self, k: &Matrix3<f64>) -> Matrix3<f64> {
        let mut matrix = *k;
        for column in 0..3 {
            matrix[(0, column)] = (k[(0, column)] - self.offset.0 * k[(2, column)]) / self.scale.0;
            matrix[(1, column)] = (k[(1, column)] - self.offset.1 * k[(2, column)]) / self.scale.1;
        }
        matrix
    }

    /// A map at the size of the image: bilinear within a surface, nearest at its edges, NaN outside the network's input.
    pub fn at_image(&self, map: &Image<f32>, (width, height): (usize, usize)) -> Image<f32> {
        let (w, h) = (map.width(), map.height());
        Image::from_fn(width, height, |x, y| {
            let u = self.scale.0 * (x as f64 + 0.5) + self.offset.0;
            let v = self.scale.1 * (y as f64 + 0.5) + self.offset.1;
            if !(0.0..=w as f64).contains(&u) || !(0.0..=h as f64).contains(&v) || w == 0 || h == 0 {
                return f32::NAN;
            }
            let clamped = |c: f64, n: usize| (c - 0.5).clamp(0.0, (n - 1) as f64);
            let (fx, fy) = (clamped(u, w), clamped(v, h));
            let (x0, y0) = (fx as usize, fy as usize);
            let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
            let (ax, ay) = ((fx - x0 as f64) as f32, (fy - y0 as f64) as f32);
            let near = [map[(x0, y0)], map[(x1, y0)], map[(x0, y1)], map[(x1, y1)]];
            let (low, high) =
                near.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(l, m), z| (l.min(*z), m.max(*z)));
            if !(high <= low * EDGE_RATIO) || near.iter().any(|z| z.is_nan()) {
                return map[(fx.round() as usize, fy.round() as usize)];
            }
            let top = near[0] + ax * (near[1] - near[0]);
            let bottom = near[2] + ax * (near[3] - near[2]);
            top + ay * (bottom - top)
        })
    }
}

/// The nearest value of a map at the size of the image; for confidences, which must not be interpolated.
pub(super) fn nearest(map: &Image<f32>, (width, height): (usize, usize)) -> Image<f32> {
    let at =
        |c: usize, to: usize, from: usize| ((c * from + from / 2) / to.max(1)).min(from.saturating_sub(1));
    Image::from_fn(width, height, |x, y| map[(at(x, width, map.width()), at(y, height, map.height()))])
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_da3::preprocess::ResizeMethod;

    #[test]
    fn planes_and_edges_are_preserved() {
        let config = PreprocessConfig { process_size_px: 56, ..PreprocessConfig::default() };
        let mapping = Mapping::new((112, 84), (56, 42), &config).unwrap();
        let plane = Image::from_fn(56, 42, |x, y| 100.0 + x as f32 * 2.0 + y as f32);
        let large = mapping.at_image(&plane, (112, 84));
        // Pixel 10 of the image has its centre at 5.25 of the map, a quarter before the centre of pixel 5.
        assert!((large[(10, 10)] - (100.0 + 2.0 * 4.75 + 4.75)).abs() < 1e-4, "{}", large[(10, 10)]);
        let step = Image::from_fn(56, 42, |x, _| if x < 28 { 1.0 } else { 9.0 });
        assert!(mapping.at_image(&step, (112, 84)).data().iter().all(|z| *z == 1.0 || *z == 9.0));
    }

    #[test]
    fn cropped_pixels_have_no_depth_and_the_camera_is_unchanged() {
        let config = PreprocessConfig { process_size_px: 60, method: ResizeMethod::UpperBoundCrop };
        let mapping = Mapping::new((120, 90), (56, 42), &config).unwrap();
        let large = mapping.at_image(&Image::filled(56, 42, 2.0), (120, 90));
        assert!(large[(0, 0)].is_nan() && large[(119, 89)].is_nan() && large[(60, 45)] == 2.0);
        // 120 → 60, cut 2 on the left: a principal point of 28 lay at 30 of 60, hence at 60 of 120.
        let k = Matrix3::new(50.0, 0.0, 28.0, 0.0, 50.0, 21.0, 0.0, 0.0, 1.0);
        let original = mapping.intrinsics_of_image(&k);
        assert_eq!((original[(0, 0)], original[(0, 2)]), (100.0, 60.0));
    }
}
