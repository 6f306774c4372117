//! A room whose every length is known: 4 m by 3 m by 2.5 m, seen from inside, vertices every 25 cm.

use nalgebra::{Matrix3, Vector3};
use vidar_core::{
    BodyFrame, CameraId, Image, Pinhole, PointCloud, Se3, So3, StampedPose, Timestamp, Trajectory,
    TriangleMesh,
};
use vidar_view::{
    Field, FieldKind, FieldValues, Figure, InteractiveView, Pane, PanePath, PaneScale, PanesShown, PathRole,
    PosedThumbnail, Report, Section, depth_thumbnail, encode_png, encode_view, render_html,
};

const SIZE: [f32; 3] = [4.0, 3.0, 2.5];
const EDGE: f32 = 0.25;
/// A point that every view of the whole room shows.
pub const MIDDLE: [f64; 3] = [2.0, 1.5, 0.6];

/// Six walls whose fronts are inside, with a pattern of colours.
pub fn mesh() -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    for axis in 0..3 {
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        let (nu, nv) = ((SIZE[u] / EDGE) as usize, (SIZE[v] / EDGE) as usize);
        for is_far in [false, true] {
            let first = mesh.positions.len();
            for i in 0..=nu {
                for j in 0..=nv {
                    let mut p = [0.0; 3];
                    p[axis] = if is_far { SIZE[axis] } else { 0.0 };
                    (p[u], p[v]) = (i as f32 * EDGE, j as f32 * EDGE);
                    mesh.positions.push(p);
                    let mut color = [120, 120, 120];
                    color[axis] = if (i + j) % 2 == 0 { 220 } else { 160 };
                    mesh.colors.push(color);
                    mesh.confidences.push(i as f32 / nu as f32);
                }
            }
            let at = |i: usize, j: usize| (first + i * (nv + 1) + j) as u32;
            for i in 0..nu {
                for j in 0..nv {
                    let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
                    let quad = if is_far { [[a, c, b], [a, d, c]] } else { [[a, b, c], [a, c, d]] };
                    mesh.triangles.extend(quad);
                }
            }
        }
    }
    mesh
}

/// Cameras on a circle that look outwards, level.
fn pose(i: usize) -> Se3 {
    let angle = i as f64 * 0.3;
    let forward = Vector3::new(angle.cos(), angle.sin(), 0.0);
    let down = -Vector3::z();
    let rotation = So3::from_matrix(&Matrix3::from_columns(&[down.cross(&forward), down, forward])).unwrap();
    Se3::new(rotation, Vector3::new(2.0, 1.5, 1.2) + 0.6 * forward)
}

fn flight(offset: f64) -> Trajectory {
    let poses = (0..20).map(|i| {
        let pose = pose(i);
        StampedPose {
            time: Timestamp::from_nanos(1_600_000_000_000_000_000 + i as i64 * 200_000_000),
            world_from_body: Se3::new(pose.rotation, pose.translation + Vector3::new(0.0, 0.0, offset)),
        }
    });
    Trajectory::new(BodyFrame::Camera(CameraId(0)), poses.collect()).unwrap()
}

fn keyframes() -> Vec<PosedThumbnail> {
    let picture = Image::from_fn(96, 64, |x, y| [(2 * x) as u8, (3 * y) as u8, 128]);
    let depth = Image::from_fn(96, 64, |x, y| if y < 4 { f32::NAN } else { 1.0 + x as f32 / 48.0 });
    (0..20)
        .step_by(4)
        .map(|i| PosedThumbnail {
            frame: i as u32,
            time_ns: i as i64 * 200_000_000,
            world_from_camera: pose(i),
            intrinsics: Pinhole::new(60.0, 60.0, 47.5, 31.5, 96, 64).unwrap(),
            // Browsers look at the first bytes, not at the name of the format.
            image_jpeg: encode_png(&picture).ok(),
            depth: depth_thumbnail(&depth, 96).ok(),
        })
        .collect()
}

/// A report with the room, its scale known to 1.2 % or not at all, beside a reference of points.
pub fn page(is_metric: bool) -> String {
    let mesh = mesh();
    let scan = PointCloud::from_positions(mesh.positions.clone());
    let (path, truth) = (flight(0.0), flight(0.02));
    let errors: Vec<f32> = mesh.positions.iter().map(|p| 0.02 * p[0]).collect();
    let sigmas: Vec<f32> = mesh.positions.iter().map(|p| 0.01 + 0.01 * p[1]).collect();
    let samples = |kind, label: &str, values| Field {
        kind,
        label: label.into(),
        values: FieldValues::Samples { positions: &mesh.positions, values, range: (0.0, 0.1) },
    };
    let of = |name: &str, role, trajectory| PanePath { name: name.into(), role, trajectory };
    let map = Pane {
        name: "map".into(),
        mesh: Some(&mesh),
        cloud: None,
        fields: vec![
            Field { kind: FieldKind::Confidence, label: "confidence".into(), values: FieldValues::Own },
            samples(FieldKind::Error, "distance to the reference [m]", &errors),
            samples(FieldKind::Sigma, "standard deviation of depth [m]", &sigmas),
            Field {
                kind: FieldKind::Difference,
                label: "difference".into(),
                values: FieldValues::Missing("there is one map".into()),
            },
        ],
        paths: vec![of("trajectory", PathRole::Estimate, &path), of("ground truth", PathRole::Truth, &truth)],
        keyframes: keyframes(),
        scale: if is_metric { PaneScale::Metric { log_std: Some(0.012) } } else { PaneScale::Arbitrary },
    };
    let reference = Pane {
        name: "reference".into(),
        mesh: None,
        cloud: Some(&scan),
        fields: Vec::new(),
        paths: Vec::new(),
        keyframes: Vec::new(),
        scale: PaneScale::Reference,
    };
    let view = InteractiveView {
        panes: vec![map, reference],
        up: Vector3::z(),
        shown: PanesShown::First,
        coloring: None,
    };
    let png = encode_png(&Image::filled(8, 8, [90; 3])).unwrap();
    let figure = Figure { png, caption: "the map from above".into(), ..Figure::default() };
    render_html(&Report {
        title: "A room".into(),
        view: Some(encode_view(&view).unwrap()),
        sections: vec![Section { heading: "Map".into(), figures: vec![figure], ..Section::default() }],
        ..Report::default()
    })
}
