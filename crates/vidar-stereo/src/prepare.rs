//! Preparation of views for matching: grey, at the working size, with two coarser levels and their intrinsics.

use crate::config::{PoseStd, StereoConfig};
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
    /// Row-major, whether a sample around the pixel mixes in one that must not be used; empty where every pixel may be.
    pub hidden: Vec<bool>,
}

/// A view ready to be matched.
#[derive(Clone, Debug)]
pub(crate) struct Prepared {
    pub frame_id: FrameId,
    pub world_from_camera: Se3,
    /// Size and residual of its pose correction; zero where poses are taken as given.
    pub correction: PoseCorrection,
    /// Standard deviation of its corrected pose; `None` where poses are taken as given.
    pub pose_std: Option<PoseStd>,
    /// Working size, half of it, a quarter of it.
    pub levels: [Level; 3],
    /// Row-major at the working size, the pixels that get no depth; empty where every pixel may.
    pub masked: Vec<bool>,
}

/// Checks a view and brings it to the working size. `mask` has the image's size; what is `true` in it is not used.
pub(crate) fn prepare(
    view: &ChunkView,
    mask: Option<&Image<bool>>,
    config: &StereoConfig,
) -> Result<Prepared, StereoError> {
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
        Level {
            width: w,
            height: h,
            gray: in_units(&area_average(&gray, w, h)),
            intrinsics,
            hidden: Vec::new(),
        }
    } else {
        Level { width, height, gray: in_units(gray.data()), intrinsics: k, hidden: Vec::new() }
    };
    if working.width < MIN_SIZE_PX || working.height < MIN_SIZE_PX {
        return Err(too_small(working.width, working.height));
    }
    let half = halved(&working);
    let quarter = halved(&half);
    let mut levels = [working, half, quarter];
    let mut masked = Vec::new();
    if let Some(mask) = mask {
        let (found_width, found_height) = (mask.width(), mask.height());
        if (found_width, found_height) != (width, height) {
            return Err(StereoError::MaskSize {
                frame,
                width: found_width,
                height: found_height,
                expected_width: width,
                expected_height: height,
            });
        }
        if mask.data().contains(&true) {
            masked = reduced(mask, levels[0].width, levels[0].height);
            for level in &mut levels {
                level.hidden = dilated(&reduced(mask, level.width, level.height), level.width, level.height);
            }
        }
    }
    let correction = PoseCorrection::default();
    Ok(Prepared { frame_id: frame, world_from_camera, correction, pose_std: None, levels, masked })
}

/// A mask at a smaller size: `true` where any of the pixels that a target pixel covers is.
fn reduced(mask: &Image<bool>, width: usize, height: usize) -> Vec<bool> {
    let mut out = vec![false; width * height];
    for y in 0..mask.height() {
        for (x, _) in mask.row(y).iter().enumerate().filter(|(_, m)| **m) {
            // A source pixel reaches into the target pixels from its first to its last part.
            let [x0, x1] = [x * width / mask.width(), ((x + 1) * width - 1) / mask.width()];
            let [y0, y1] = [y * height / mask.height(), ((y + 1) * height - 1) / mask.height()];
            for row in y0..=y1.min(height - 1) {
                out[row * width + x0..=row * width + x1.min(width - 1)].fill(true);
            }
        }
    }
    out
}

/// `true` where a sample around the pixel mixes in a `true` one. Windows may reach further: on the walker of the tests, 1, 2 and 3 pixels
/// leave 1781, 1529 and 896 right depths within 6 pixels of the mask, of 1266 without one, and 17, 16 and 13 wrong ones, of 334.
fn dilated(mask: &[bool], width: usize, height: usize) -> Vec<bool> {
    let reach = 1;
    let mut out = vec![false; mask.len()];
    for (i, _) in mask.iter().enumerate().filter(|(_, m)| **m) {
        let (x, y) = (i % width, i / width);
        for row in y.saturating_sub(reach)..(y + reach + 1).min(height) {
            out[row * width + x.saturating_sub(reach)..row * width + (x + reach + 1).min(width)].fill(true);
        }
    }
    out
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
    Level { width, height, gray, intrinsics, hidden: Vec::new() }
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
    fn a_mask_hides_every_sample_that_touches_it_at_each_size() {
        let k = Pinhole::new(100.0, 100.0, 50.0, 33.0, 101, 67).expect("valid");
        let image = vidar_core::FrameImage::Gray8(Image::filled(101, 67, 90));
        let view = ChunkView {
            frame_id: FrameId(0),
            time: vidar_core::Timestamp::default(),
            image,
            intrinsics: k,
            world_from_camera: Some(Se3::IDENTITY),
        };
        let mask = Image::from_fn(101, 67, |x, y| (x, y) == (60, 40));
        let config = StereoConfig { max_width_px: 80, ..StereoConfig::default() };
        let prepared = prepare(&view, Some(&mask), &config).expect("fits");
        // 60 · 80/101 = 47.5 and 61 · 80/101 = 48.3, 40 · 53/67 = 31.6 and 41 · 53/67 = 32.4: pixels 47 and 48, 31 and 32.
        let masked: Vec<_> = (0..80 * 53).filter(|i| prepared.masked[*i]).map(|i| (i % 80, i / 80)).collect();
        assert_eq!(masked, [(47, 31), (48, 31), (47, 32), (48, 32)]);
        let hidden = |level: &Level| level.hidden.iter().filter(|h| **h).count();
        assert_eq!(prepared.levels.each_ref().map(hidden)[0], 4 * 4, "one more pixel on each side");
        assert!(prepared.levels[2].hidden[8 * 20 + 12] && !prepared.levels[2].hidden[8 * 20 + 4]);
        let without = prepare(&view, Some(&Image::filled(101, 67, false)), &config).expect("fits");
        assert!(
            without.masked.is_empty() && without.levels[0].hidden.is_empty(),
            "an empty mask costs nothing"
        );
        let wrong = prepare(&view, Some(&Image::filled(67, 101, false)), &config);
        assert!(matches!(wrong, Err(StereoError::MaskSize { width: 67, .. })), "{wrong:?}");
    }

    #[test]
    fn halving_keeps_the_directions_of_pixels() {
        let intrinsics = Pinhole::new(100.0, 110.0, 31.0, 20.5, 65, 43).expect("valid");
        let gray = (0..65 * 43).map(|i| (i % 65) as i16 * 4).collect();
        let level = Level { width: 65, height: 43, gray, intrinsics, hidden: Vec::new() };
        let half = halved(&level);
        assert_eq!((half.width, half.height), (32, 21));
        let fine = (level.intrinsics.ray(10.0, 6.0) + level.intrinsics.ray(11.0, 7.0)) * 0.5;
        assert!((half.intrinsics.ray(5.0, 3.0) - fine).norm() < 1e-12);
        assert_eq!(half.gray[5], 42);
    }
}
