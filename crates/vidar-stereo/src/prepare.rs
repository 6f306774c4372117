//! Preparation of views for matching: grey, at the working size, with two coarser levels and their intrinsics.

use crate::config::StereoConfig;
use crate::error::StereoError;
use vidar_core::{ChunkView, FrameId, Image, Pinhole, Se3};

/// Size and residual of a view's pose correction, medians in working pixels.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct PoseCorrection {
    /// Shift of the view's matches by the correction.
    pub shift_px: f32,
    /// Residual of the matches with the corrected poses.
    pub residual_px: f32,
}

/// Fewest rows and columns of a working image: the coarsest level then still contains a few windows.
pub(crate) const MIN_SIZE_PX: usize = 32;

/// Image units per grey level: an area average has that much detail below a grey level.
pub(crate) const GRAY_STEPS: i32 = 16;
/// The middle of the range, image units.
const MIDDLE: i32 = 128 * GRAY_STEPS;

/// One level of the image pyramid.
#[derive(Clone, Debug)]
pub(crate) struct Level {
    pub width: usize,
    pub height: usize,
    /// Row-major grey levels in [`GRAY_STEPS`]ths, less the middle one: −2048…2032.
    pub gray: Vec<i16>,
    pub intrinsics: Pinhole,
}

/// A view ready to be matched.
#[derive(Clone, Debug)]
pub(crate) struct Prepared {
    pub frame_id: FrameId,
    pub world_from_camera: Se3,
    /// Size and residual of its pose correction; zero where poses are taken as given.
    pub correction: PoseCorrection,
    /// Working size, half of it, a quarter of it.
    pub levels: [Level; 3],
}

/// Checks a view and brings it to the working size.
pub(crate) fn prepare(view: &ChunkView, config: &StereoConfig) -> Result<Prepared, StereoError> {
    let frame = view.frame_id;
    let world_from_camera = view.world_from_camera.ok_or(StereoError::MissingPose { frame })?;
    if !world_from_camera.is_finite() {
        return Err(StereoError::BadPose { frame });
    }
    let k = &view.intrinsics;
    let (width, height) = (view.image.width(), view.image.height());
    if (width, height) != (k.width, k.height) {
        let (expected_width, expected_height) = (k.width, k.height);
        return Err(StereoError::SizeMismatch { frame, width, height, expected_width, expected_height });
    }
    let too_small = |width, height| StereoError::TooSmall { frame, width, height, needed: MIN_SIZE_PX };
    if width < MIN_SIZE_PX || height < MIN_SIZE_PX {
        return Err(too_small(width, height));
    }
    let bad_intrinsics = || StereoError::BadIntrinsics { frame, fx: k.fx, fy: k.fy, cx: k.cx, cy: k.cy };
    // The fields are public, so the constructor's checks are repeated.
    let k = Pinhole::new(k.fx, k.fy, k.cx, k.cy, k.width, k.height).map_err(|_| bad_intrinsics())?;
    let gray = view.image.to_gray_f32();
    let working = if width > config.max_width_px {
        let w = config.max_width_px;
        let h = ((height as f64 * w as f64 / width as f64).round() as usize).max(1);
        let intrinsics = k.resized(w, h).map_err(|_| bad_intrinsics())?;
        Level { width: w, height: h, gray: in_units(&area_average(&gray, w, h)), intrinsics }
    } else {
        Level { width, height, gray: in_units(gray.data()), intrinsics: k }
    };
    if working.width < MIN_SIZE_PX || working.height < MIN_SIZE_PX {
        return Err(too_small(working.width, working.height));
    }
    let half = halved(&working);
    let quarter = halved(&half);
    Ok(Prepared {
        frame_id: frame,
        world_from_camera,
        correction: PoseCorrection::default(),
        levels: [working, half, quarter],
    })
}

/// Grey levels in image units.
fn in_units(gray: &[f32]) -> Vec<i16> {
    gray.iter().map(|g| (g * GRAY_STEPS as f32 + 0.5) as i16 - MIDDLE as i16).collect()
}

/// Mean over blocks of 2 × 2; an odd last row or column is left out.
fn halved(level: &Level) -> Level {
    let (width, height) = (level.width / 2, level.height / 2);
    let mut gray = Vec::with_capacity(width * height);
    for y in 0..height {
        let top = &level.gray[2 * y * level.width..][..level.width];
        let bottom = &level.gray[(2 * y + 1) * level.width..][..level.width];
        let pairs = top.as_chunks::<2>().0.iter().zip(bottom.as_chunks::<2>().0);
        let mean = |(t, b): (&[i16; 2], &[i16; 2])| (t[0] + t[1] + b[0] + b[1] + 2) >> 2;
        gray.extend(pairs.map(mean));
    }
    let k = &level.intrinsics;
    let half = |c: f64| (c + 0.5) * 0.5 - 0.5;
    let intrinsics =
        Pinhole { fx: k.fx * 0.5, fy: k.fy * 0.5, cx: half(k.cx), cy: half(k.cy), width, height };
    Level { width, height, gray, intrinsics }
}

/// Exact area average: every source pixel is weighted by its overlap with the target pixel.
fn area_average(image: &Image<f32>, width: usize, height: usize) -> Vec<f32> {
    let columns = overlaps(image.width(), width);
    let rows = overlaps(image.height(), height);
    let mut across = vec![0.0f32; width * image.height()];
    for y in 0..image.height() {
        let source = image.row(y);
        for (target, (first, weights)) in across[y * width..][..width].iter_mut().zip(&columns) {
            *target = source[*first..].iter().zip(weights).map(|(p, w)| p * w).sum();
        }
    }
    let mut out = vec![0.0f32; width * height];
    for (y, (first, weights)) in rows.iter().enumerate() {
        let target = &mut out[y * width..][..width];
        for (i, w) in weights.iter().enumerate() {
            let source = &across[(first + i) * width..][..width];
            for (t, s) in target.iter_mut().zip(source) {
                *t += w * s;
            }
        }
    }
    out
}

/// For each target pixel the first source pixel it touches, and the weights (summing to 1) from there on.
fn overlaps(source: usize, target: usize) -> Vec<(usize, Vec<f32>)> {
    let scale = source as f64 / target as f64;
    (0..target)
        .map(|t| {
            let (from, to) = (t as f64 * scale, ((t + 1) as f64 * scale).min(source as f64));
            let first = from.floor() as usize;
            let last = (to.ceil() as usize).min(source);
            let overlap = |s: usize| (to.min((s + 1) as f64) - from.max(s as f64)).max(0.0) / (to - from);
            (first, (first..last).map(|s| overlap(s) as f32).collect())
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn area_average_keeps_a_ramp_where_the_resized_intrinsics_put_it() {
        let image = Image::from_fn(101, 67, |x, y| x as f32 + 3.0 * y as f32);
        let (w, h) = (40, 30);
        let small = area_average(&image, w, h);
        for y in 0..h {
            for x in 0..w {
                // c' = (c + 0.5) s − 0.5, solved for the source position.
                let sx = (x as f32 + 0.5) * 101.0 / 40.0 - 0.5;
                let sy = (y as f32 + 0.5) * 67.0 / 30.0 - 0.5;
                let expected = sx + 3.0 * sy;
                // Pixels are flat squares, so the mean over part of one is off by up to an eighth of its slope.
                assert!(
                    (small[y * w + x] - expected).abs() < 0.2,
                    "{x} {y}: {} {expected}",
                    small[y * w + x]
                );
            }
        }
    }

    #[test]
    fn halving_keeps_the_directions_of_pixels() {
        let intrinsics = Pinhole::new(100.0, 110.0, 31.0, 20.5, 65, 43).expect("valid");
        let gray = (0..65 * 43).map(|i| (i % 65) as i16 * 4).collect();
        let level = Level { width: 65, height: 43, gray, intrinsics };
        let half = halved(&level);
        assert_eq!((half.width, half.height), (32, 21));
        let fine = (level.intrinsics.ray(10.0, 6.0) + level.intrinsics.ray(11.0, 7.0)) * 0.5;
        assert!((half.intrinsics.ray(5.0, 3.0) - fine).norm() < 1e-12);
        assert_eq!(half.gray[5], 42);
    }
}
