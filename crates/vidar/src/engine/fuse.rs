//! Fuse: placed depth into one surface, as triangles and as points.

use super::events::{MapEvent, Surface};
use crate::error::Error;
use vidar_core::{AlignedView, TriangleMesh, Warning};
use vidar_fusion::{DoubleWallDetector, FusionConfig, PointFusion, TsdfVolume};

/// Both forms of the surface, fed with the same views.
pub struct SurfaceFusion {
    volume: TsdfVolume,
    points: PointFusion,
}

impl SurfaceFusion {
    /// An empty surface.
    pub fn new(fusion: &FusionConfig) -> Result<Self, Error> {
        Ok(Self { volume: TsdfVolume::new(fusion)?, points: PointFusion::new(fusion)? })
    }

    /// Adds views; those that cannot be fused are reported and left out.
    pub fn fuse(&mut self, views: &[AlignedView]) -> Vec<MapEvent> {
        let mut events = Vec::new();
        for view in views {
            for result in [self.volume.integrate(view).map(|_| ()), self.points.integrate(view).map(|_| ())] {
                if let Err(error) = result {
                    let warning = Warning::degraded("view-not-fused", error.to_string());
                    events.push(MapEvent::Warning(warning.at(format!("frame {}", view.frame_id()))));
                }
            }
        }
        events
    }

    /// The triangles so far.
    pub fn mesh(&self) -> TriangleMesh {
        self.volume.extract_mesh()
    }

    /// The surface, and what fusion reports. One form after the other: the sums of what is done are given up before the next is made.
    pub fn finish(self) -> (Surface, Vec<Warning>) {
        let Self { volume, points } = self;
        let mut warnings = volume.warnings();
        warnings.extend(points.warnings());
        let cloud = points.finish();
        let mesh = volume.extract_mesh();
        let coverage = volume.coverage(&mesh);
        let (voxel_m, volume_bytes) = (volume.config().voxel_size_m, volume.peak_memory_bytes());
        drop(volume);
        // About two voxels: nearer ones are the roughness of one surface.
        let walls = DoubleWallDetector {
            min_distance_m: 2.0 * voxel_m,
            max_distance_m: (12.0 * voxel_m).max(0.25),
            radius_m: voxel_m,
            ..DoubleWallDetector::default()
        };
        (Surface { coverage, double_walls: walls.of_mesh(&mesh).ok(), volume_bytes, cloud, mesh }, warnings)
    }
}
