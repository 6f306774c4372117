//! What the placed views become: one surface in two forms, and a file each for depth and picture.

use super::MetricMap;
use crate::config::Config;
use crate::error::Error;
use crate::events::{Event, Events};
use crate::run_folder::{RunFolder, StoredView};
use rayon::prelude::*;
use vidar_core::{AlignedView, Warning};
use vidar_fusion::{DoubleWalls, FusionConfig, PointFusion, TsdfVolume};

/// Both forms of the surface, fed with the same views.
pub(super) struct Surface {
    volume: TsdfVolume,
    points: PointFusion,
}

impl Surface {
    /// Nothing yet.
    pub(super) fn new(fusion: &FusionConfig) -> Result<Self, Error> {
        Ok(Self { volume: TsdfVolume::new(fusion)?, points: PointFusion::new(fusion)? })
    }

    /// Adds views.
    pub(super) fn fuse(&mut self, views: &[AlignedView], events: &Events) -> Result<(), Error> {
        for view in views {
            // A view that cannot be fused is a named degradation of the map, not the end of the run.
            for result in [self.volume.integrate(view).map(|_| ()), self.points.integrate(view).map(|_| ())] {
                if let Err(error) = result {
                    let place = format!("frame {}", view.frame_id());
                    events.warn(&Warning::new("view-not-fused", error.to_string()).at(place));
                }
            }
        }
        Ok(())
    }

    /// Mesh, cloud and what there is to say of them.
    pub(super) fn extract(self, map: &mut MetricMap) {
        map.mesh = self.volume.extract_mesh();
        map.coverage = self.volume.coverage(&map.mesh);
        map.volume_bytes = self.volume.peak_memory_bytes();
        let voxel_m = self.volume.config().voxel_size_m;
        // About two voxels: nearer ones are the roughness of one surface.
        let walls = DoubleWalls {
            nearest_m: 2.0 * voxel_m,
            farthest_m: (12.0 * voxel_m).max(0.25),
            beside_m: voxel_m,
            ..DoubleWalls::default()
        };
        map.double_walls = walls.of_mesh(&map.mesh).ok();
        map.warnings = self.volume.warnings();
        map.warnings.extend(self.points.warnings());
        map.cloud = self.points.finish();
    }
}

/// Writes depth and image of every view as it is finished, so that a crash later loses nothing.
pub(super) fn store(
    views: &[AlignedView],
    config: &Config,
    folder: &RunFolder,
    events: &Events,
) -> Result<Vec<StoredView>, Error> {
    folder.file("depth/.")?;
    folder.file("images/.")?;
    let stored: Result<Vec<_>, Error> =
        views.par_iter().map(|view| store_one(view, config, folder)).collect();
    let stored = stored?;
    for (_, artifacts) in &stored {
        for (path, bytes) in artifacts {
            events.emit(&Event::ArtifactWritten { path: path.clone(), bytes: *bytes });
        }
    }
    Ok(stored.into_iter().map(|(view, _)| view).collect())
}

type Artifacts = Vec<(String, u64)>;

fn store_one(
    view: &AlignedView,
    config: &Config,
    folder: &RunFolder,
) -> Result<(StoredView, Artifacts), Error> {
    let mut artifacts = Artifacts::new();
    let name = format!("{:06}.png", view.frame_id().0);
    let mut depth = None;
    if config.output.depth_png {
        let path = format!("depth/{name}");
        let mut bytes = Vec::new();
        vidar_export::write_depth_png(&mut bytes, view.depth(), config.output.depth_units_per_metre)?;
        artifacts.push((path.clone(), folder.write(&path, &bytes)?));
        depth = Some(path);
    }
    let mut image = None;
    if let (true, Some(color)) = (config.output.images, view.color()) {
        let path = format!("images/{name}");
        artifacts.push((path.clone(), folder.write(&path, &vidar_view::encode_png(color)?)?));
        image = Some(path);
    }
    let m = view.world_from_camera().matrix();
    let rows = std::array::from_fn(|r| std::array::from_fn(|c| m[(r, c)]));
    let stored = StoredView {
        frame: view.frame_id().0,
        time_ns: view.time().nanos(),
        image,
        depth,
        intrinsics: *view.intrinsics(),
        world_from_camera: rows,
    };
    Ok((stored, artifacts))
}
