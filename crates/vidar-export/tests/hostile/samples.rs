//! A small valid file of every format.

use crate::common::*;
use std::fs;
use vidar_core::{Image, MetricDepth, Timestamp};
use vidar_export::*;

pub type Reader = fn(&[u8]) -> Result<(), ExportError>;

/// A small valid file, its reader, and whether truncation at any byte is detected.
pub struct Sample {
    pub name: &'static str,
    pub bytes: Vec<u8>,
    pub read: Reader,
    pub truncation_is_detected: bool,
}

fn colmap_file(format: ColmapFormat, name: &str) -> Vec<u8> {
    let dir = tempfile::tempdir().unwrap();
    write_colmap(dir.path(), format, &small_views(), &cloud_of(&small_mesh()), &[]).unwrap();
    fs::read(dir.path().join(name)).unwrap()
}

pub const NO_RECORDS: &[u8] = &[0; 8];

pub fn samples() -> Vec<Sample> {
    let (trajectory, mesh, views) = (small_trajectory(), small_mesh(), small_views());
    let depth = MetricDepth::new(Image::from_fn(5, 4, |x, y| if x == y { f32::NAN } else { (x + y) as f32 }));
    let frame = DepthFrame::new("0.png", views[1].frame_id, views[1].time, &views[1].world_from_camera);
    let sidecar = DepthSidecar::new(1000.0, &views[0].intrinsics, vec![frame]);
    let ascii_ply =
        b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
        element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n";
    let sample = |name, bytes, read: Reader, truncation_is_detected| Sample {
        name,
        bytes,
        read,
        truncation_is_detected,
    };
    use ColmapFormat::{Binary, Text};
    vec![
        sample("tum", written(|w| write_tum(w, &trajectory, "note")), |b| read_tum(b).map(drop), false),
        sample(
            "euroc",
            written(|w| write_euroc_csv(w, &trajectory, "")),
            |b| read_euroc_csv(b).map(drop),
            false,
        ),
        sample(
            "kitti",
            written(|w| write_kitti(w, &trajectory)),
            |b| {
                let times = [0, 1].map(Timestamp::from_nanos).to_vec();
                read_kitti(b, &KittiTimes { body: small_trajectory().body(), times }).map(drop)
            },
            // A cut through the last number leaves a number.
            false,
        ),
        sample(
            "times",
            written(|w| write_kitti_times(w, &trajectory, "")),
            |b| read_kitti_times(b).map(drop),
            false,
        ),
        sample("ply", written(|w| write_ply_mesh(w, &mesh, &[])), |b| read_ply(b).map(drop), true),
        sample("ascii ply", ascii_ply.to_vec(), |b| read_ply(b).map(drop), false),
        sample("glb", written(|w| write_glb_mesh(w, &mesh, &["x".into()])), |b| read_glb(b).map(drop), true),
        sample(
            "transforms",
            written(|w| write_transforms_json(w, &views, Some("p.ply"))),
            |b| read_transforms_json(b).map(drop),
            false,
        ),
        sample("sidecar", written(|w| sidecar.write(w)), |b| DepthSidecar::read(b).map(drop), false),
        sample(
            "depth",
            written(|w| write_depth_png(w, &depth, 1000.0).map(drop)),
            |b| read_depth_png(b, 1000.0).map(drop),
            true,
        ),
        sample(
            "cameras.txt",
            colmap_file(Text, "cameras.txt"),
            |b| read_colmap_bytes(Text, b, b"", b"").map(drop),
            false,
        ),
        sample(
            "images.txt",
            colmap_file(Text, "images.txt"),
            |b| read_colmap_bytes(Text, b"1 PINHOLE 64 48 100 110 32 24\n", b, b"").map(drop),
            false,
        ),
        sample(
            "points3D.txt",
            colmap_file(Text, "points3D.txt"),
            |b| read_colmap_bytes(Text, b"", b"", b).map(drop),
            false,
        ),
        sample(
            "cameras.bin",
            colmap_file(Binary, "cameras.bin"),
            |b| read_colmap_bytes(Binary, b, NO_RECORDS, NO_RECORDS).map(drop),
            true,
        ),
        sample(
            "images.bin",
            colmap_file(Binary, "images.bin"),
            |b| read_colmap_bytes(Binary, &colmap_file(Binary, "cameras.bin"), b, NO_RECORDS).map(drop),
            true,
        ),
        sample(
            "points3D.bin",
            colmap_file(Binary, "points3D.bin"),
            |b| read_colmap_bytes(Binary, NO_RECORDS, NO_RECORDS, b).map(drop),
            true,
        ),
    ]
}
