//! Depth in chunk units and depth in metres are different types, so that one cannot be fused as the other.
//!
//! [`RelativeDepth::to_metric`] converts with a given scale:
//!
//! ```
//! use vidar_core::{Image, MetricDepth, RelativeDepth};
//! fn fuse(depth: &MetricDepth) -> f64 { depth.valid_ratio() }
//!
//! let predicted = RelativeDepth::new(Image::filled(4, 3, 2.0));
//! assert_eq!(fuse(&predicted.to_metric(0.5)?), 1.0);
//! # Ok::<(), vidar_core::GeometryError>(())
//! ```
//!
//! ```compile_fail,E0308
//! use vidar_core::{Image, MetricDepth, RelativeDepth};
//! fn fuse(depth: &MetricDepth) -> f64 { depth.valid_ratio() }
//!
//! let predicted = RelativeDepth::new(Image::filled(4, 3, 2.0));
//! fuse(&predicted);
//! ```
//!
//! An aligned view cannot be made of chunk units either:
//!
//! ```compile_fail,E0308
//! use vidar_core::{AlignedView, Confidence, FrameId, Image, Pinhole, RelativeDepth, Se3, Timestamp};
//! let intrinsics = Pinhole::new(4.0, 4.0, 1.5, 1.0, 4, 3).unwrap();
//! let depth = RelativeDepth::new(Image::filled(4, 3, 2.0));
//! let at = Timestamp::from_nanos(0);
//! let _ = AlignedView::new(FrameId(0), at, Se3::IDENTITY, intrinsics, depth, Confidence::full(4, 3));
//! ```

use crate::camera::Pinhole;
use crate::id::FrameId;
use crate::image::Image;
use crate::lie::Se3;
use crate::origin::DepthOrigin;
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

/// Why a view cannot be assembled.
#[derive(Clone, Debug, PartialEq, Error)]
#[non_exhaustive]
pub enum GeometryError {
    /// Two images that must share a size do not.
    #[error("{what}: expected {expected_width}x{expected_height}, found {width}x{height}")]
    SizeMismatch {
        /// Which image.
        what: &'static str,
        /// Columns expected.
        expected_width: usize,
        /// Rows expected.
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

/// Replaces invalid depths (zero, negative, infinite) by NaN.
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

/// A view with metric depth and a pose in the world frame: the only input that fusion accepts.
#[derive(Clone, Debug)]
pub struct AlignedView {
    frame_id: FrameId,
    time: Timestamp,
    world_from_camera: Se3,
    intrinsics: Pinhole,
    depth: MetricDepth,
    confidence: Confidence,
    color: Option<Image<[u8; 3]>>,
    origin: Option<Image<DepthOrigin>>,
}

impl AlignedView {
    /// Assembles a metric view. Alignment, RGB-D readers and synthetic worlds do this; models do not.
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
        Ok(Self {
            frame_id,
            time,
            world_from_camera,
            intrinsics,
            depth,
            confidence,
            color: None,
            origin: None,
        })
    }

    /// The same view with colours.
    pub fn with_color(mut self, color: Image<[u8; 3]>) -> Result<Self, GeometryError> {
        check_size("color", &color, self.intrinsics.width, self.intrinsics.height)?;
        self.color = Some(color);
        Ok(self)
    }

    /// The same view with the source of each pixel's depth.
    pub fn with_origin(mut self, origin: Image<DepthOrigin>) -> Result<Self, GeometryError> {
        check_size("source", &origin, self.intrinsics.width, self.intrinsics.height)?;
        self.origin = Some(origin);
        Ok(self)
    }

    /// Which frame it is.
    pub fn frame_id(&self) -> FrameId {
        self.frame_id
    }

    /// Time of the exposure.
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

    /// Where each pixel's depth comes from, where a view has several sources.
    pub fn origin(&self) -> Option<&Image<DepthOrigin>> {
        self.origin.as_ref()
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lie::So3;
    use nalgebra::Vector3;

    const BAD: [f32; 6] = [0.0, -1.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -0.0];

    fn row(values: &[f32]) -> Image<f32> {
        Image::from_vec(values.len(), 1, values.to_vec()).unwrap()
    }

    #[test]
    fn what_cannot_be_a_depth_becomes_not_a_number() {
        for bad in BAD {
            let metric = MetricDepth::new(row(&[bad, 2.5]));
            assert!(metric.image()[(0, 0)].is_nan() && metric.image()[(1, 0)] == 2.5, "{bad}");
            assert_eq!(metric.valid_ratio(), 0.5);
            assert!(RelativeDepth::new(row(&[bad])).image()[(0, 0)].is_nan());
        }
        assert_eq!(MetricDepth::new(Image::filled(0, 0, 1.0)).valid_ratio(), 0.0);
    }

    #[test]
    fn scaling_keeps_holes_and_refuses_what_is_no_scale() {
        let relative = RelativeDepth::new(row(&[1.5, f32::NAN, 1e38]));
        let metric = relative.to_metric(4.0).unwrap();
        assert_eq!(metric.image()[(0, 0)], 6.0);
        // A depth beyond the range of f32 is no depth.
        assert!(metric.image()[(1, 0)].is_nan() && metric.image()[(2, 0)].is_nan());
        for bad in [0.0, -1.0, f64::INFINITY] {
            assert_eq!(relative.to_metric(bad), Err(GeometryError::BadScale { scale: bad }));
        }
        assert!(matches!(relative.to_metric(f64::NAN), Err(GeometryError::BadScale { .. })));
    }

    #[test]
    fn confidence_stays_between_zero_and_one() {
        let confidence = Confidence::new(row(&[-0.5, 0.25, 1.5, f32::NAN, f32::INFINITY, f32::NEG_INFINITY]));
        assert_eq!(confidence.image().data(), &[0.0, 0.25, 1.0, 0.0, 1.0, 0.0]);
        assert!(Confidence::full(3, 2).image().data().iter().all(|&c| c == 1.0));
    }

    fn view(
        depth: (usize, usize),
        confidence: (usize, usize),
        at: Se3,
    ) -> Result<AlignedView, GeometryError> {
        AlignedView::new(
            FrameId(7),
            Timestamp::from_nanos(5),
            at,
            Pinhole::new(10.0, 10.0, 2.0, 1.0, 5, 3).unwrap(),
            MetricDepth::new(Image::filled(depth.0, depth.1, 1.0)),
            Confidence::full(confidence.0, confidence.1),
        )
    }

    #[test]
    fn a_view_holds_images_of_one_size_at_a_finite_place() {
        let good = view((5, 3), (5, 3), Se3::IDENTITY).unwrap();
        assert_eq!(
            (good.frame_id(), good.time(), good.color()),
            (FrameId(7), Timestamp::from_nanos(5), None)
        );
        let mismatch = |what, width, height| GeometryError::SizeMismatch {
            what,
            expected_width: 5,
            expected_height: 3,
            width,
            height,
        };
        assert_eq!(view((3, 5), (5, 3), Se3::IDENTITY).unwrap_err(), mismatch("depth", 3, 5));
        assert_eq!(view((5, 3), (5, 4), Se3::IDENTITY).unwrap_err(), mismatch("confidence", 5, 4));
        let color = good.clone().with_color(Image::filled(1, 3, [0; 3])).unwrap_err();
        assert_eq!(color, mismatch("color", 1, 3));
        assert_eq!(color.to_string(), "color: expected 5x3, found 1x3");
        assert!(good.with_color(Image::filled(5, 3, [1; 3])).unwrap().color().is_some());
        let nowhere = Se3::new(So3::IDENTITY, Vector3::new(0.0, f64::NAN, 0.0));
        assert_eq!(view((5, 3), (5, 3), nowhere).unwrap_err(), GeometryError::BadPose { frame: FrameId(7) });
    }
}
