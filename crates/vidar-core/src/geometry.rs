//! Depth in chunk units and depth in metres are different types, so that one cannot be fused as the other.

use crate::camera::Pinhole;
use crate::id::FrameId;
use crate::image::Image;
use crate::lie::Se3;
use crate::time::Timestamp;
use thiserror::Error;

/// z-depth in the units of the chunk that predicted it; NaN = no depth.
#[derive(Clone, Debug, PartialEq)]
pub struct RelativeDepth(Image<f32>);

/// z-depth in metres; NaN = no depth.
#[derive(Clone, Debug, PartialEq)]
pub struct MetricDepth(Image<f32>);

/// Confidence per pixel in 0…1: the estimated probability that the depth is within its stated tolerance.
#[derive(Clone, Debug, PartialEq)]
pub struct Confidence(Image<f32>);

/// Why geometry cannot be put together.
#[derive(Clone, Debug, PartialEq, Error)]
#[non_exhaustive]
pub enum GeometryError {
    /// Two images that must share a size do not.
    #[error("{what}: expected {expected_width}x{expected_height}, found {width}x{height}")]
    SizeMismatch {
        /// Which image.
        what: &'static str,
        /// Columns wanted.
        expected_width: usize,
        /// Rows wanted.
        expected_height: usize,
        /// Columns found.
        width: usize,
        /// Rows found.
        height: usize,
    },
    /// A scale is zero, negative or not finite.
    #[error("scale must be finite and positive, found {scale}")]
    BadScale {
        /// The value.
        scale: f64,
    },
    /// A pose holds a value that is not finite.
    #[error("pose of frame {frame} is not finite")]
    BadPose {
        /// Whose pose.
        frame: FrameId,
    },
}

/// Turns what cannot be a depth (zero, negative, infinite) into NaN.
fn cleaned(mut image: Image<f32>) -> Image<f32> {
    for z in image.data_mut() {
        if !(z.is_finite() && *z > 0.0) {
            *z = f32::NAN;
        }
    }
    image
}

impl RelativeDepth {
    /// Takes z-depths in chunk units; values that are not finite and positive become NaN.
    pub fn new(depth: Image<f32>) -> Self {
        Self(cleaned(depth))
    }

    /// The depths.
    pub fn image(&self) -> &Image<f32> {
        &self.0
    }

    /// The same depths in metres, given metres per chunk unit.
    pub fn to_metric(&self, metres_per_unit: f64) -> Result<MetricDepth, GeometryError> {
        if !(metres_per_unit.is_finite() && metres_per_unit > 0.0) {
            return Err(GeometryError::BadScale { scale: metres_per_unit });
        }
        Ok(MetricDepth::new(self.0.map(|&z| (f64::from(z) * metres_per_unit) as f32)))
    }
}

impl MetricDepth {
    /// Takes z-depths in metres; values that are not finite and positive become NaN.
    pub fn new(depth: Image<f32>) -> Self {
        Self(cleaned(depth))
    }

    /// The depths.
    pub fn image(&self) -> &Image<f32> {
        &self.0
    }

    /// Share of pixels that have a depth, 0…1.
    pub fn valid_ratio(&self) -> f64 {
        let n = self.0.data().len();
        if n == 0 {
            return 0.0;
        }
        self.0.data().iter().filter(|z| !z.is_nan()).count() as f64 / n as f64
    }
}

impl Confidence {
    /// Takes confidences, clamped to 0…1; NaN becomes 0.
    pub fn new(mut confidence: Image<f32>) -> Self {
        for c in confidence.data_mut() {
            *c = if c.is_nan() { 0.0 } else { c.clamp(0.0, 1.0) };
        }
        Self(confidence)
    }

    /// Full confidence everywhere.
    pub fn full(width: usize, height: usize) -> Self {
        Self(Image::filled(width, height, 1.0))
    }

    /// The confidences.
    pub fn image(&self) -> &Image<f32> {
        &self.0
    }
}

/// A view whose depth is metric and whose pose is in the world: the only thing fusion accepts.
#[derive(Clone, Debug)]
pub struct AlignedView {
    frame_id: FrameId,
    time: Timestamp,
    world_from_camera: Se3,
    intrinsics: Pinhole,
    depth: MetricDepth,
    confidence: Confidence,
    color: Option<Image<[u8; 3]>>,
}

impl AlignedView {
    /// Puts a metric view together. Alignment, RGB-D readers and synthetic worlds do this; models do not.
    ///
    /// `intrinsics`, `depth`, `confidence` and `color` share one size.
    pub fn new(
        frame_id: FrameId,
        time: Timestamp,
        world_from_camera: Se3,
        intrinsics: Pinhole,
        depth: MetricDepth,
        confidence: Confidence,
    ) -> Result<Self, GeometryError> {
        let (width, height) = (intrinsics.width, intrinsics.height);
        check_size("depth", depth.image(), width, height)?;
        check_size("confidence", confidence.image(), width, height)?;
        if !world_from_camera.is_finite() {
            return Err(GeometryError::BadPose { frame: frame_id });
        }
        Ok(Self { frame_id, time, world_from_camera, intrinsics, depth, confidence, color: None })
    }

    /// The same view with colours.
    pub fn with_color(mut self, color: Image<[u8; 3]>) -> Result<Self, GeometryError> {
        check_size("color", &color, self.intrinsics.width, self.intrinsics.height)?;
        self.color = Some(color);
        Ok(self)
    }

    /// Which frame it is.
    pub fn frame_id(&self) -> FrameId {
        self.frame_id
    }

    /// When it was taken.
    pub fn time(&self) -> Timestamp {
        self.time
    }

    /// Its pose: maps camera coordinates to the world.
    pub fn world_from_camera(&self) -> &Se3 {
        &self.world_from_camera
    }

    /// Its (distortion-free) intrinsics at the depth's size.
    pub fn intrinsics(&self) -> &Pinhole {
        &self.intrinsics
    }

    /// z-depth, metres.
    pub fn depth(&self) -> &MetricDepth {
        &self.depth
    }

    /// Confidence in the depth.
    pub fn confidence(&self) -> &Confidence {
        &self.confidence
    }

    /// Colours at the depth's size, if known.
    pub fn color(&self) -> Option<&Image<[u8; 3]>> {
        self.color.as_ref()
    }
}

/// Checks that `image` is `width` × `height`.
pub fn check_size<P>(
    what: &'static str,
    image: &Image<P>,
    width: usize,
    height: usize,
) -> Result<(), GeometryError> {
    if image.width() == width && image.height() == height {
        return Ok(());
    }
    Err(GeometryError::SizeMismatch {
        what,
        expected_width: width,
        expected_height: height,
        width: image.width(),
        height: image.height(),
    })
}
