//! Merging the sensors of a dataset into one stream in the order of time.

use crate::dataset::Dataset;
use crate::error::DatasetError;
use vidar_core::{Frame, SensorEvent, StampedPose};

/// A cursor into each sensor's list. The order at equal times is the order of the fields.
pub(crate) struct Events<'a> {
    dataset: &'a Dataset,
    truth: &'a [StampedPose],
    next: [usize; 4],
}

impl<'a> Events<'a> {
    pub(crate) fn new(dataset: &'a Dataset) -> Self {
        let truth = dataset.ground_truth.as_ref().map_or(&[][..], |t| t.poses());
        Self { dataset, truth, next: [0; 4] }
    }

    fn event(&self, sensor: usize, index: usize) -> Result<SensorEvent, DatasetError> {
        let d = self.dataset;
        Ok(match sensor {
            0 => SensorEvent::Imu(d.imu[index]),
            1 => {
                let StampedPose { time, world_from_body } = self.truth[index];
                SensorEvent::GroundTruth { time, world_from_body }
            }
            2 => {
                let entry = &d.depths[index];
                SensorEvent::Depth { time: entry.time, camera: d.camera, depth: d.load_depth(entry)? }
            }
            _ => {
                let entry = &d.images[index];
                let image = d.load_image(entry)?;
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

impl Iterator for Events<'_> {
    type Item = Result<SensorEvent, DatasetError>;

    fn next(&mut self) -> Option<Self::Item> {
        let d = self.dataset;
        let heads = [
            d.imu.get(self.next[0]).map(|s| s.time),
            self.truth.get(self.next[1]).map(|p| p.time),
            d.depths.get(self.next[2]).map(|e| e.time),
            d.images.get(self.next[3]).map(|e| e.time),
        ];
        let (_, sensor) = heads.iter().enumerate().filter_map(|(i, t)| t.map(|t| (t, i))).min()?;
        let index = self.next[sensor];
        self.next[sensor] += 1;
        Some(self.event(sensor, index))
    }
}
