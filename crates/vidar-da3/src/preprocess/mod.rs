//! From images to the network's input, as the official `InputProcessor` does it.
//!
//! An image is scaled so that its longer (or shorter) side has the wanted length, then resized or cut to multiples of
//! the patch; both steps give bytes. Sizes round half to even at the first step and ties up at the second. Shrinking
//! is OpenCV's `INTER_AREA` bit by bit ([`area`]), enlarging its `INTER_CUBIC` ([`cubic`]). Intrinsics follow with the
//! origin at the *edge* of the top-left pixel: scaling has no half-pixel term. Files' EXIF orientation is ignored.

pub mod area;
pub mod cubic;
mod normalise;

pub use normalise::{denormalise, normalise, normalise_into};

use crate::config::PATCH;
use crate::error::Da3Error;
use nalgebra::Matrix3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use vidar_core::Image;

/// Which side is scaled to the wanted length, and how multiples of the patch are reached.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ResizeMethod {
    /// The longer side; both sides are then stretched to the nearest multiple of 14.
    #[default]
    UpperBoundResize,
    /// The longer side; then cut to multiples of 14 about the centre.
    UpperBoundCrop,
    /// The shorter side; then stretched.
    LowerBoundResize,
    /// The shorter side; then cut.
    LowerBoundCrop,
}

/// How images are brought to the network's size.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PreprocessConfig {
    /// Wanted length of the bounding side, pixels, 14 to 4096. More shows more detail at quadratic cost; networks were
    /// trained around 504.
    pub process_size_px: usize,
    /// Which side that is and how multiples of 14 are reached.
    pub method: ResizeMethod,
}

impl Default for PreprocessConfig {
    fn default() -> Self {
        Self { process_size_px: 504, method: ResizeMethod::UpperBoundResize }
    }
}

impl PreprocessConfig {
    /// Refuses sizes outside 14 to 4096.
    pub fn validate(&self) -> Result<(), Da3Error> {
        if !(PATCH..=4096).contains(&self.process_size_px) {
            return Err(Da3Error::BadInput {
                what: "process_size_px",
                reason: format!("{} pixels, expected {PATCH} to 4096", self.process_size_px),
            });
        }
        Ok(())
    }
}

/// How a resize interpolates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Interpolation {
    /// Mean over the source area: [`area::resize`].
    Area,
    /// Keys' cubic: [`cubic::resize`].
    Cubic,
}

/// One step from an image to the network's size.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// Resize to a width and height.
    Resize {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// How.
        interpolation: Interpolation,
    },
    /// Keep a part.
    Crop {
        /// First column kept.
        left: usize,
        /// First row kept.
        top: usize,
        /// Columns kept.
        width: usize,
        /// Rows kept.
        height: usize,
    },
}

/// The steps for an image of `width` × `height`, none to two of them.
pub fn plan(width: usize, height: usize, config: &PreprocessConfig) -> Result<Vec<Step>, Da3Error> {
    config.validate()?;
    if width == 0 || height == 0 {
        return Err(Da3Error::BadInput { what: "image", reason: format!("{width}x{height} pixels") });
    }
    let wanted = config.process_size_px;
    let (side, is_crop) = match config.method {
        ResizeMethod::UpperBoundResize => (width.max(height), false),
        ResizeMethod::UpperBoundCrop => (width.max(height), true),
        ResizeMethod::LowerBoundResize => (width.min(height), false),
        ResizeMethod::LowerBoundCrop => (width.min(height), true),
    };
    let mut steps = Vec::new();
    let (mut w, mut h) = (width, height);
    if side != wanted {
        let scale = wanted as f64 / side as f64;
        let scaled = |length: usize| ((length as f64 * scale).round_ties_even() as usize).max(1);
        (w, h) = (scaled(width), scaled(height));
        let interpolation = if scale > 1.0 { Interpolation::Cubic } else { Interpolation::Area };
        steps.push(Step::Resize { width: w, height: h, interpolation });
    }
    if is_crop {
        let (width, height) = (w / PATCH * PATCH, h / PATCH * PATCH);
        if width == 0 || height == 0 {
            let reason = format!("{w}x{h} pixels after scaling, a side is shorter than a patch of {PATCH}");
            return Err(Da3Error::BadInput { what: "image", reason });
        }
        if (width, height) != (w, h) {
            steps.push(Step::Crop { left: (w - width) / 2, top: (h - height) / 2, width, height });
        }
    } else {
        let (width, height) = (nearest_multiple(w), nearest_multiple(h));
        if (width, height) != (w, h) {
            let interpolation =
                if width > w || height > h { Interpolation::Cubic } else { Interpolation::Area };
            steps.push(Step::Resize { width, height, interpolation });
        }
    }
    Ok(steps)
}

/// The multiple of the patch next to a length, ties up, at least one patch.
fn nearest_multiple(length: usize) -> usize {
    let down = length / PATCH * PATCH;
    let up = if length - down >= PATCH.div_ceil(2) { down + PATCH } else { down };
    up.max(PATCH)
}

/// Width and height at which an image of the given size reaches the network (before the batch is made equal).
pub fn processed_size(
    width: usize,
    height: usize,
    config: &PreprocessConfig,
) -> Result<(usize, usize), Da3Error> {
    let last = plan(width, height, config)?.pop();
    Ok(match last {
        Some(Step::Resize { width, height, .. } | Step::Crop { width, height, .. }) => (width, height),
        None => (width, height),
    })
}

/// Images of equal size, ready to be normalised.
#[derive(Clone, Debug)]
pub struct Batch {
    /// The processed images.
    pub images: Vec<Image<[u8; 3]>>,
    /// Their intrinsics, origin at the edge of the top-left pixel, if any were given.
    pub intrinsics: Option<Vec<Matrix3<f64>>>,
    /// Whether the images ended in different sizes and were cut to the smallest of them.
    pub was_cropped: bool,
}

impl Batch {
    /// Columns of every image.
    pub fn width(&self) -> usize {
        self.images.first().map_or(0, Image::width)
    }

    /// Rows of every image.
    pub fn height(&self) -> usize {
        self.images.first().map_or(0, Image::height)
    }
}

/// Processes the images of a batch, with intrinsics at the size of the images given.
pub fn process(
    images: &[&Image<[u8; 3]>],
    intrinsics: Option<&[Matrix3<f64>]>,
    config: &PreprocessConfig,
) -> Result<Batch, Da3Error> {
    if let Some(given) = intrinsics.filter(|k| k.len() != images.len()) {
        let reason = format!("{} for {} images", given.len(), images.len());
        return Err(Da3Error::BadInput { what: "intrinsics", reason });
    }
    let done: Vec<Processed> = images
        .par_iter()
        .enumerate()
        .map(|(i, image)| process_one(image, intrinsics.map(|k| k[i]), config).map_err(|e| in_view(i, &e)))
        .collect::<Result<_, _>>()?;
    let (images, intrinsics): (Vec<_>, Vec<_>) = done.into_iter().unzip();
    let mut batch = Batch { images, intrinsics: intrinsics.into_iter().collect(), was_cropped: false };
    let width = batch.images.iter().map(Image::width).min().unwrap_or(0);
    let height = batch.images.iter().map(Image::height).min().unwrap_or(0);
    for i in 0..batch.images.len() {
        let (w, h) = (batch.images[i].width(), batch.images[i].height());
        if (w, h) == (width, height) {
            continue;
        }
        batch.was_cropped = true;
        let step = Step::Crop { left: (w - width) / 2, top: (h - height) / 2, width, height };
        batch.images[i] = apply(&batch.images[i], step);
        if let Some(k) = &mut batch.intrinsics {
            k[i] = follow(&k[i], (w, h), step);
        }
    }
    Ok(batch)
}

fn in_view(view: usize, error: &Da3Error) -> Da3Error {
    Da3Error::BadView { view, reason: error.to_string() }
}

/// An image and its intrinsics.
type Processed = (Image<[u8; 3]>, Option<Matrix3<f64>>);

fn process_one(
    image: &Image<[u8; 3]>,
    intrinsics: Option<Matrix3<f64>>,
    config: &PreprocessConfig,
) -> Result<Processed, Da3Error> {
    let mut current: Option<Image<[u8; 3]>> = None;
    let mut matrix = intrinsics;
    for step in plan(image.width(), image.height(), config)? {
        let source = current.as_ref().unwrap_or(image);
        matrix = matrix.map(|k| follow(&k, (source.width(), source.height()), step));
        current = Some(apply(source, step));
    }
    Ok((current.unwrap_or_else(|| image.clone()), matrix))
}

/// Does one step to an image.
pub fn apply(image: &Image<[u8; 3]>, step: Step) -> Image<[u8; 3]> {
    match step {
        Step::Resize { width, height, interpolation: Interpolation::Area } => {
            area::resize(image, width, height)
        }
        Step::Resize { width, height, interpolation: Interpolation::Cubic } => {
            cubic::resize(image, width, height)
        }
        Step::Crop { left, top, width, height } => {
            let columns = left..left + width;
            let data = (top..top + height).flat_map(|y| &image.row(y)[columns.clone()]).copied().collect();
            Image::from_vec(width, height, data).unwrap_or_else(|_| image.clone())
        }
    }
}

/// What a step does to intrinsics (origin at the edge of the top-left pixel) of an image of `(width, height)`.
pub fn follow(intrinsics: &Matrix3<f64>, (width, height): (usize, usize), step: Step) -> Matrix3<f64> {
    let mut k = *intrinsics;
    match step {
        Step::Resize { width: w, height: h, .. } => {
            let (sx, sy) = (w as f64 / width as f64, h as f64 / height as f64);
            k.row_mut(0).scale_mut(sx);
            k.row_mut(1).scale_mut(sy);
        }
        Step::Crop { left, top, .. } => {
            k[(0, 2)] -= left as f64;
            k[(1, 2)] -= top as f64;
        }
    }
    k
}

#[cfg(test)]
mod tests;
