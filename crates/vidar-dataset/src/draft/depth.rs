//! The depth camera of a recording, completed.

use super::Draft;
use crate::assemble::keep_existing;
use crate::checks;
use crate::error::DatasetError;
use crate::options::OpenOptions;
use crate::recording::{DepthEntry, DepthSensor, Recording};
use vidar_core::{Pinhole, Se3, Warning};

impl Draft {
    pub(super) fn complete_depth(
        &mut self,
        options: &OpenOptions,
        dataset: &mut Recording,
    ) -> Result<(), DatasetError> {
        let Some(mut depth) = self.depth.take() else { return Ok(()) };
        let mut depths = std::mem::take(&mut self.depths);
        let notes = &mut dataset.warnings;
        keep_existing(&mut depths, "depth images", &self.root, notes)?;
        checks::put_in_order(&mut depths, |d| d.0, "depth images", &self.root, notes);
        let Some((_, first)) = depths.first() else { return Ok(()) };
        let (width, height) = self.media.size(first)?;
        let Some(camera) = dataset.rig.camera(dataset.camera) else { return Ok(()) };
        let bad = |key: &str| {
            let (path, key) = (first.place(), key.to_string());
            move |source| DatasetError::BadCamera { path, key, source }
        };
        let intrinsics = match options.depth_intrinsics.or(depth.intrinsics) {
            Some([fx, fy, cx, cy]) => {
                Pinhole::new(fx, fy, cx, cy, width, height).map_err(bad("depth intrinsics"))?
            }
            None => {
                if !depth.is_registered {
                    notes.push(
                        Warning::new(
                            "depth-intrinsics",
                            "no intrinsics of the depth camera; those of the colour camera are used",
                        )
                        .at(self.root.display())
                        .hint("--depth-intrinsics fx,fy,cx,cy"),
                    );
                }
                camera.model.intrinsics().resized(width, height).map_err(bad("depth intrinsics"))?
            }
        };
        // Intrinsics from a flag describe images without distortion, and so does a model of another size.
        let distorted = depth.distorted.take().filter(|model| {
            options.depth_intrinsics.is_none() && (model.width(), model.height()) == (width, height)
        });
        let units_per_metre = match options.depth_scale.or(depth.units_per_metre) {
            Some(units) => units,
            None => {
                let message = format!(
                    "the unit of depth is not stated; assumed: {} per metre, as usual for {}",
                    depth.default_units, self.kind
                );
                notes.push(
                    Warning::new("depth-scale", message).at(self.root.display()).hint("--depth-scale UNITS"),
                );
                depth.default_units
            }
        };
        let by_rig =
            depth.body_from_depth.map(|b| vidar_core::LieGroup::inverse(&camera.body_from_camera) * b);
        let color_from_depth = match options.color_from_depth.or(by_rig) {
            Some(motion) => motion,
            None => {
                if !depth.is_registered {
                    notes.push(
                        Warning::new(
                            "depth-extrinsics",
                            "no pose of the depth camera is given; assumed: that of the colour camera",
                        )
                        .at(self.root.display())
                        .hint("--color-from-depth"),
                    );
                }
                Se3::IDENTITY
            }
        };
        dataset.depth_sensor = Some(DepthSensor {
            intrinsics,
            distorted,
            units_per_metre,
            color_from_depth,
            invalid: depth.invalid,
        });
        dataset.depths = depths.into_iter().map(|(time, location)| DepthEntry { time, location }).collect();
        Ok(())
    }
}
