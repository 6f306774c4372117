//! Merging the sensors of a dataset into one stream in the order of time.

use crate::error::DatasetError;
use crate::recording::{ImageEntry, Recording};
use vidar_core::{Frame, FrameImage, SensorEvent, StampedPose};

/// How far the stream of a dataset was read; a new one stands before the first event.
///
/// It borrows nothing, so that a stream can be kept beside the dataset that it belongs to ([`Recording::next_event`]).
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct EventCursor {
    /// Samples taken of IMU, ground truth, depth and images: the order at equal times.
    taken: [usize; 4],
}

impl Recording {
    /// The event at the cursor, which moves past it, also past one that cannot be read; `None` at the end. An image is decoded when it is the
    /// event; [`Recording::events`] decodes ahead.
    ///
    /// # Errors
    /// An image or a depth image cannot be read.
    pub fn next_event(&self, cursor: &mut EventCursor) -> Option<Result<SensorEvent, DatasetError>> {
        self.event_after(cursor, |entry| self.load_image(entry))
    }

    /// The same with pixels from elsewhere.
    pub(crate) fn event_after(
        &self,
        cursor: &mut EventCursor,
        pixels: impl FnOnce(&ImageEntry) -> Result<FrameImage, DatasetError>,
    ) -> Option<Result<SensorEvent, DatasetError>> {
        let truth = self.ground_truth.as_ref().map_or(&[][..], |t| t.poses());
        let [imu, pose, depth, image] = cursor.taken;
        let heads = [
            self.imu.get(imu).map(|s| s.time),
            truth.get(pose).map(|p| p.time),
            self.depths.get(depth).map(|e| e.time),
            self.images.get(image).map(|e| e.time),
        ];
        let (_, sensor) = heads.iter().enumerate().filter_map(|(i, t)| t.map(|t| (t, i))).min()?;
        let index = cursor.taken[sensor];
        cursor.taken[sensor] += 1;
        Some(self.event(sensor, index, pixels))
    }

    fn event(
        &self,
        sensor: usize,
        index: usize,
        pixels: impl FnOnce(&ImageEntry) -> Result<FrameImage, DatasetError>,
    ) -> Result<SensorEvent, DatasetError> {
        Ok(match (sensor, &self.ground_truth) {
            (0, _) => SensorEvent::Imu(self.imu[index]),
            (1, Some(truth)) => {
                let StampedPose { time, world_from_body } = truth.poses()[index];
                SensorEvent::GroundTruth { time, world_from_body }
            }
            (2, _) => {
                let entry = &self.depths[index];
                SensorEvent::Depth { time: entry.time, camera: self.camera, depth: self.load_depth(entry)? }
            }
            _ => {
                let entry = &self.images[index];
                let image = pixels(entry)?;
                SensorEvent::Image(Frame {
                    id: entry.frame_id,
                    time: entry.time,
                    camera: entry.camera,
                    image,
                })
            }
        })
    }
}
