//! Keyframes as the model sees them: read, undistorted, as they would look if all rows had been exposed with the middle one, with
//! their prior pose.

use super::events::{MapEvent, MapKeyframe};
use super::setup::ImageSource;
use rayon::prelude::*;
use std::ops::Range;
use vidar_core::remap::{RemapTable, ViewShift};
use vidar_core::{CameraModel, ChunkView, FrameImage, Image, Pinhole, Warning};

/// Shifts of rows below this many pixels of the camera are left: matches are found to a few tenths of one.
const LEAST_SHIFT_PX: f64 = 0.25;

/// A view with what of it is not to be used: `true` there; `None` where all of it is.
pub type MaskedView = (ChunkView, Option<Image<bool>>);

/// An image with `value` where the mask is `true`.
pub fn blanked<T: Copy>(image: &Image<T>, mask: &Image<bool>, value: T) -> Image<T> {
    Image::from_fn(image.width(), image.height(), |x, y| if mask[(x, y)] { value } else { image[(x, y)] })
}

/// Views that were handed out.
pub struct Taken {
    /// The views.
    pub views: Vec<ChunkView>,
    /// One entry per view.
    pub masks: Vec<Option<Image<bool>>>,
    /// Those of them that are wanted.
    pub wanted: Range<usize>,
    /// Which keyframes they are.
    pub indices: Vec<usize>,
}

/// A window of undistorted keyframes that moves forward through the sequence; each image is read once, and again where the window is
/// moved back.
pub struct ViewWindow<'a> {
    images: &'a dyn ImageSource,
    camera: CameraModel,
    remap: RemapTable,
    /// Keyframe index with its view and its mask, ascending. Unreadable images are missing.
    views: Vec<(usize, MaskedView)>,
    /// The first keyframe that it was moved to, and the one after the last.
    start: usize,
    next: usize,
}

impl<'a> ViewWindow<'a> {
    /// An empty window before the first keyframe.
    pub fn new(images: &'a dyn ImageSource, camera: &CameraModel, view: &Pinhole) -> Self {
        let remap = RemapTable::new(camera, view);
        Self { images, camera: camera.clone(), remap, views: Vec::new(), start: 0, next: 0 }
    }

    /// Moves back before the first keyframe.
    pub fn reset(&mut self) {
        self.views.clear();
        (self.start, self.next) = (0, 0);
    }

    /// Moves the window to the keyframes `seen`, reading what is new. Unreadable images are reported and left out.
    pub fn advance(&mut self, keyframes: &[MapKeyframe], seen: &Range<usize>, report: &mut Vec<MapEvent>) {
        if seen.start < self.start {
            self.reset();
        }
        self.start = seen.start;
        self.views.retain(|(index, _)| seen.contains(index));
        // A scale that was settled has moved keyframes since.
        self.views
            .iter_mut()
            .for_each(|(k, (view, _))| view.world_from_camera = keyframes[*k].world_from_camera);
        let fresh: Vec<usize> = (self.next.max(seen.start)..seen.end).collect();
        let loaded: Vec<_> = fresh.par_iter().map(|&index| (index, self.load(&keyframes[index]))).collect();
        for (index, result) in loaded {
            match result {
                Ok(view) => self.views.push((index, view)),
                Err(warning) => report.push(MapEvent::Warning(warning)),
            }
        }
        self.next = self.next.max(seen.end);
    }

    /// Hands the views out, until [`ViewWindow::put_back`], with the span of those that lie in `wanted`.
    pub fn take(&mut self, wanted: &Range<usize>) -> Taken {
        let (indices, views): (Vec<usize>, Vec<MaskedView>) =
            std::mem::take(&mut self.views).into_iter().unzip();
        let (views, masks) = views.into_iter().unzip();
        let start = indices.partition_point(|&i| i < wanted.start);
        let end = indices.partition_point(|&i| i < wanted.end);
        Taken { views, masks, wanted: start..end, indices }
    }

    /// Takes the views back.
    pub fn put_back(&mut self, views: Vec<ChunkView>, masks: Vec<Option<Image<bool>>>, indices: Vec<usize>) {
        self.views = indices.into_iter().zip(views.into_iter().zip(masks)).collect();
    }

    /// Reads one keyframe.
    pub fn load(&self, keyframe: &MapKeyframe) -> Result<MaskedView, Warning> {
        let image = self.images.image(&keyframe.stamp)?;
        let mask = self.images.mask(&keyframe.stamp)?;
        let shift =
            keyframe.warp.and_then(|s| ViewShift::new(&self.camera, self.remap.target(), &s, LEAST_SHIFT_PX));
        // Every pixel into which an ignored one is mixed; the camera's border is black in the view, not ignored.
        let mask = mask.map(|mask| {
            let white = FrameImage::Gray8(mask.map(|ignored| if *ignored { 255 } else { 0 }));
            self.remap.apply_shifted(&white, shift.as_ref()).to_gray8().map(|v| *v > 0)
        });
        let view = ChunkView {
            frame_id: keyframe.stamp.frame_id,
            time: keyframe.stamp.time,
            image: self.remap.apply_shifted(&image, shift.as_ref()),
            intrinsics: *self.remap.target(),
            world_from_camera: keyframe.world_from_camera,
        };
        Ok((view, mask))
    }
}
