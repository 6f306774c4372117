//! Small data in every format, and strategies that make more of it.
#![allow(dead_code)] // Each test binary uses its own share of these.

use nalgebra::{Vector3, Vector6};
use proptest::prelude::*;
use vidar_core::trajectory::{BodyFrame, StampedPose, Trajectory};
use vidar_core::{CameraId, FrameId, LieGroup, Pinhole, PointCloud, Se3, So3, Timestamp, TriangleMesh};
use vidar_export::ExportView;

/// A quarter turn about z, and a step: every sign and every axis of it is seen in a file.
pub fn quarter_turn() -> Se3 {
    let half = 0.5_f64.sqrt();
    Se3::new(So3::from_quaternion(0.0, 0.0, half, half).unwrap(), Vector3::new(1.0, -2.5, 0.25))
}

pub fn small_trajectory() -> Trajectory {
    let pose = |nanos, world_from_body| StampedPose { time: Timestamp::from_nanos(nanos), world_from_body };
    let poses =
        vec![pose(1_403_636_579_763_555_584, Se3::IDENTITY), pose(1_403_636_579_813_555_456, quarter_turn())];
    Trajectory::new(BodyFrame::Camera(CameraId(0)), poses).unwrap()
}

pub fn small_mesh() -> TriangleMesh {
    TriangleMesh {
        positions: vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.5], [0.0, 2.0, -0.25]],
        normals: vec![[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]],
        colors: vec![[255, 0, 1], [0, 128, 2], [7, 8, 9]],
        confidences: vec![0.25, 0.5, 1.0],
        triangles: vec![[0, 1, 2]],
    }
}

pub fn cloud_of(mesh: &TriangleMesh) -> PointCloud {
    PointCloud {
        positions: mesh.positions.clone(),
        normals: mesh.normals.clone(),
        colors: mesh.colors.clone(),
        confidences: mesh.confidences.clone(),
    }
}

pub fn small_views() -> Vec<ExportView> {
    let intrinsics = Pinhole::new(100.0, 110.0, 31.5, 23.5, 64, 48).unwrap();
    let view = |id: u32, name: &str, world_from_camera| ExportView {
        frame_id: FrameId(id),
        time: Timestamp::from_nanos(1_403_636_579_763_555_584 + i64::from(id)),
        image_name: name.to_owned(),
        world_from_camera,
        intrinsics,
    };
    vec![view(0, "images/a.png", Se3::IDENTITY), view(7, "images/b.png", quarter_turn())]
}

pub fn written(write: impl FnOnce(&mut Vec<u8>) -> Result<(), vidar_export::ExportError>) -> Vec<u8> {
    let mut bytes = Vec::new();
    write(&mut bytes).unwrap();
    bytes
}

/// A rigid motion with any rotation (also near 0 and π) within `reach` metres.
pub fn se3(reach: f64) -> impl Strategy<Value = Se3> {
    let angle = prop_oneof![Just(0.0), Just(std::f64::consts::PI), 0.0..std::f64::consts::PI, 1e-12..1e-6];
    let axis = (-1.0..1.0, -1.0..1.0, -1.0..1.0);
    let step = (-reach..reach, -reach..reach, -reach..reach);
    (angle, axis, step).prop_map(|(angle, (a, b, c), (x, y, z))| {
        let w = Vector3::new(a, b, c).try_normalize(1e-3).unwrap_or(Vector3::x()) * angle;
        let rotation = Se3::exp(&Vector6::new(w.x, w.y, w.z, 0.0, 0.0, 0.0)).rotation;
        Se3::new(rotation, Vector3::new(x, y, z))
    })
}

pub fn trajectory() -> impl Strategy<Value = Trajectory> {
    let body = prop_oneof![
        Just(BodyFrame::Imu),
        Just(BodyFrame::Other),
        (0_u32..9).prop_map(|n| BodyFrame::Camera(CameraId(n)))
    ];
    let start = -2_000_000_000_000_000_000_i64..2_000_000_000_000_000_000;
    let steps = proptest::collection::vec((1_i64..5_000_000_000, se3(1e4)), 0..20);
    (body, start, steps).prop_map(|(body, mut nanos, steps)| {
        let poses = steps
            .into_iter()
            .map(|(step, world_from_body)| {
                nanos += step;
                StampedPose { time: Timestamp::from_nanos(nanos), world_from_body }
            })
            .collect();
        Trajectory::new(body, poses).unwrap()
    })
}

fn finite() -> impl Strategy<Value = f32> {
    use proptest::num::f32::{NEGATIVE, NORMAL, POSITIVE, SUBNORMAL, ZERO};
    POSITIVE | NEGATIVE | NORMAL | SUBNORMAL | ZERO
}

/// A mesh with any finite floats, any set of attributes, and triangles unless `triangles` is false.
pub fn mesh() -> impl Strategy<Value = TriangleMesh> {
    let vertex =
        ([finite(), finite(), finite()], [finite(), finite(), finite()], any::<[u8; 3]>(), 0.0_f32..=1.0);
    let parts = (proptest::collection::vec(vertex, 0..12), any::<[bool; 3]>());
    let corners = proptest::collection::vec(any::<[u16; 3]>(), 0..12);
    (parts, corners).prop_map(|((vertices, has), corners)| {
        let n = vertices.len();
        let mut mesh = TriangleMesh::default();
        for (position, normal, color, confidence) in vertices {
            mesh.positions.push(position);
            mesh.normals.extend(has[0].then_some(normal));
            mesh.colors.extend(has[1].then_some(color));
            mesh.confidences.extend(has[2].then_some(confidence));
        }
        if n > 0 {
            mesh.triangles = corners.iter().map(|t| t.map(|i| u32::from(i) % n as u32)).collect();
        }
        mesh
    })
}

pub fn views() -> impl Strategy<Value = Vec<ExportView>> {
    let lens = (1.0..2000.0, 1.0..2000.0, -500.0..2500.0, -500.0..2500.0, 1_usize..4000, 1_usize..4000);
    let pinhole = lens.prop_map(|(fx, fy, cx, cy, w, h)| Pinhole::new(fx, fy, cx, cy, w, h).unwrap());
    let lenses = proptest::collection::vec(pinhole, 1..3);
    let places = proptest::collection::vec((se3(1e3), any::<i64>(), 1_u32..100, any::<usize>()), 0..10);
    (lenses, places).prop_map(|(lenses, places)| {
        let mut id = 0;
        places
            .into_iter()
            .map(|(world_from_camera, nanos, step, lens)| {
                id += step;
                ExportView {
                    frame_id: FrameId(id),
                    time: Timestamp::from_nanos(nanos),
                    image_name: format!("Küche/部屋_{id}.png"),
                    world_from_camera,
                    intrinsics: lenses[lens % lenses.len()],
                }
            })
            .collect()
    })
}

/// Largest difference between two motions, metres and radians mixed.
pub fn difference(a: &Se3, b: &Se3) -> f64 {
    (a.inverse() * *b).log().amax().max((a.translation - b.translation).amax())
}
