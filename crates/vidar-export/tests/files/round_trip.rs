//! Written data is restored: as properties over all formats, with the conventions of other tools checked.

use crate::common::*;
use nalgebra::{Matrix4, Vector3, Vector4};
use proptest::prelude::*;
use vidar_core::trajectory::{BodyFrame, Trajectory};
use vidar_core::{FrameId, Image, MetricDepth, Pinhole, PointCloud, Timestamp};
use vidar_export::*;

fn same_motion(a: &Trajectory, b: &Trajectory, tolerance: f64) {
    assert_eq!(a.body(), b.body());
    assert_eq!(a.len(), b.len());
    for (x, y) in a.poses().iter().zip(b.poses()) {
        assert_eq!(x.time, y.time);
        let apart = difference(&x.world_from_body, &y.world_from_body);
        assert!(apart < tolerance, "{apart} at {}", x.time);
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn tum_keeps_times_exactly_and_poses_to_a_nanometre(t in trajectory()) {
        let bytes = written(|w| write_tum(w, &t, "first\nsecond"));
        same_motion(&read_tum(&bytes).unwrap(), &t, 4e-9);
    }

    #[test]
    fn euroc_keeps_times_exactly_and_poses_to_a_nanometre(t in trajectory()) {
        let bytes = written(|w| write_euroc_csv(w, &t, "note"));
        same_motion(&read_euroc_csv(&bytes).unwrap(), &t, 4e-9);
    }

    #[test]
    fn kitti_and_its_times_keep_the_trajectory(t in trajectory()) {
        let matrices = written(|w| write_kitti(w, &t));
        let times = read_kitti_times(&written(|w| write_kitti_times(w, &t, "note"))).unwrap();
        // 13 significant digits of 1e4 m are 5e-9 m.
        same_motion(&read_kitti(&matrices, &times).unwrap(), &t, 2e-8);
    }

    #[test]
    fn ply_keeps_every_value_of_a_mesh_and_of_a_cloud(m in mesh(), note in "[a-zA-Zäö ]{0,20}") {
        let comments = [note.trim().to_owned()];
        let ply = read_ply(&written(|w| write_ply_mesh(w, &m, &comments))).unwrap();
        prop_assert_eq!(ply.comments.last(), comments.last());
        prop_assert_eq!(ply.into_mesh(), m.clone());
        let cloud = cloud_of(&m);
        let ply = read_ply(&written(|w| write_ply_cloud(w, &cloud, &comments))).unwrap();
        prop_assert!(ply.triangles.is_empty());
        prop_assert_eq!(ply.cloud, cloud);
    }

    #[test]
    fn glb_keeps_every_value_of_a_mesh_and_of_a_cloud(m in mesh(), note in "\\PC{0,20}") {
        let comments = [note];
        let glb = read_glb(&written(|w| write_glb_mesh(w, &m, &comments))).unwrap();
        prop_assert_eq!(&glb.comments[..], &comments[..]);
        prop_assert_eq!(&glb.mesh, &m);
        let cloud = cloud_of(&m);
        let glb = read_glb(&written(|w| write_glb_cloud(w, &cloud, &comments))).unwrap();
        prop_assert!(glb.mesh.triangles.is_empty());
        prop_assert_eq!(cloud_of(&glb.mesh), cloud);
    }

    #[test]
    fn colmap_keeps_views_and_points_in_both_formats(views in views(), m in mesh()) {
        let dir = tempfile::tempdir().unwrap();
        let points = PointCloud { normals: vec![], confidences: vec![], ..cloud_of(&m) };
        for format in [ColmapFormat::Text, ColmapFormat::Binary] {
            let folder = dir.path().join(format!("Räume {format:?}"));
            let seen = |(view, point): (usize, usize)| Observation {
                point: point as u32,
                view: view as u32,
                pixel: [point as f64 + 0.25, view as f64],
            };
            let pairs = (0..views.len()).flat_map(|v| (v..points.len()).map(move |p| (v, p)));
            write_colmap(&folder, format, &views, &points, &pairs.map(seen).collect::<Vec<_>>()).unwrap();
            let model = read_colmap(&folder).unwrap();
            prop_assert_eq!(&model.points.positions, &points.positions);
            if points.colors.is_empty() {
                prop_assert!(model.points.colors.iter().all(|c| *c == [128; 3]));
            } else {
                prop_assert_eq!(&model.points.colors, &points.colors);
            }
            prop_assert_eq!(model.views.len(), views.len());
            for (read, view) in model.views.iter().zip(&views) {
                prop_assert_eq!(read.time, None);
                check_view(read, view, 1e-11);
            }
        }
    }

    #[test]
    fn transforms_json_keeps_views(views in views(), ply in proptest::option::of("[a-z/äö]{1,9}\\.ply")) {
        let bytes = written(|w| write_transforms_json(w, &views, ply.as_deref()));
        let file = read_transforms_json(&bytes).unwrap();
        prop_assert_eq!(file.ply_path, ply);
        prop_assert_eq!(file.applied_transform, [[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., 0.]]);
        prop_assert_eq!(file.views.len(), views.len());
        for (read, view) in file.views.iter().zip(&views) {
            prop_assert_eq!(read.time, Some(view.time));
            check_view(read, view, 1e-11);
        }
    }

    #[test]
    fn depth_png_keeps_depth_to_half_a_step_and_counts_the_rest(
        z in proptest::collection::vec(prop_oneof![Just(f32::NAN), 1e-5_f32..100.0, 0.001_f32..20.0], 1..60),
        units in prop_oneof![Just(1000.0), Just(5000.0), Just(256.0)],
    ) {
        let depth = MetricDepth::new(Image::from_vec(z.len(), 1, z.clone()).unwrap());
        let mut bytes = Vec::new();
        let stats = write_depth_png(&mut bytes, &depth, units).unwrap();
        let read = read_depth_png(&bytes, units).unwrap();
        let mut counted = DepthPngStats::default();
        for (before, after) in z.iter().zip(read.image().data()) {
            let steps = (f64::from(*before) * units).round();
            if before.is_nan() {
                counted.invalid += 1;
                prop_assert!(after.is_nan());
            } else if (1.0..=65_535.0).contains(&steps) {
                counted.written += 1;
                prop_assert!((f64::from(*before) - f64::from(*after)).abs() <= 0.501 / units + 1e-5);
            } else {
                counted.clipped += 1;
                prop_assert!(after.is_nan(), "{before} came back as {after}");
            }
        }
        prop_assert_eq!(stats, counted);
    }

    #[test]
    fn depth_sidecar_keeps_every_bit(views in views()) {
        let intrinsics = small_views()[0].intrinsics;
        let frame = |v: &ExportView| DepthFrame::new(format!("{}.png", v.frame_id), v.frame_id, v.time, &v.world_from_camera);
        let sidecar = DepthSidecar::new(1000.0, &intrinsics, views.iter().map(frame).collect());
        let read = DepthSidecar::read(&written(|w| sidecar.write(w))).unwrap();
        prop_assert_eq!(&read, &sidecar);
        prop_assert_eq!(read.pinhole().unwrap(), intrinsics);
        for (frame, view) in read.frames.iter().zip(&views) {
            prop_assert!(difference(&frame.world_from_camera().unwrap(), &view.world_from_camera) < 1e-12);
        }
    }
}

fn check_view(read: &ImportedView, view: &ExportView, tolerance: f64) {
    assert_eq!(read.frame_id, Some(view.frame_id));
    assert_eq!(read.image_name, view.image_name);
    let apart = difference(&read.world_from_camera, &view.world_from_camera);
    // Lengths up to 1e3 m, rotations about them.
    assert!(apart < tolerance * 1e3, "{apart}");
    let (a, b) = (read.intrinsics, view.intrinsics);
    assert_eq!((a.fx, a.fy, a.width, a.height), (b.fx, b.fy, b.width, b.height));
    // Adding and taking off half a pixel rounds in the last bit.
    assert!((a.cx - b.cx).abs() < 1e-12 * 4096.0 && (a.cy - b.cy).abs() < 1e-12 * 4096.0);
}

/// A point in front of the second small view and its pixel, top-left pixel centre (0, 0).
fn point_and_pixel(view: &ExportView) -> (Vector3<f64>, [f64; 2]) {
    let in_camera = Vector3::new(0.3, -0.2, 2.0);
    let pixel = view.intrinsics.project(&in_camera).unwrap();
    (view.world_from_camera * in_camera, [pixel.x, pixel.y])
}

#[test]
fn colmaps_own_projection_lands_half_a_pixel_further() {
    let dir = tempfile::tempdir().unwrap();
    let views = small_views();
    write_colmap(dir.path(), ColmapFormat::Text, &views, &PointCloud::default(), &[]).unwrap();
    let cameras = std::fs::read_to_string(dir.path().join("cameras.txt")).unwrap();
    let images = std::fs::read_to_string(dir.path().join("images.txt")).unwrap();
    let k: Vec<f64> =
        cameras.lines().last().unwrap().split(' ').skip(2).map(|t| t.parse().unwrap()).collect();
    let line = images.lines().find(|l| l.starts_with("8 ")).unwrap();
    let v: Vec<f64> = line.split(' ').take(8).map(|t| t.parse().unwrap()).collect();
    let (point, pixel) = point_and_pixel(&views[1]);
    // Written out as COLMAP's documentation does: x_camera = R(q) X + t, then the pinhole.
    let q = nalgebra::UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(v[1], v[2], v[3], v[4]));
    let x = q * point + Vector3::new(v[5], v[6], v[7]);
    let colmap_pixel = [k[2] * x.x / x.z + k[4], k[3] * x.y / x.z + k[5]];
    assert!((colmap_pixel[0] - pixel[0] - 0.5).abs() < 1e-12, "{colmap_pixel:?} {pixel:?}");
    assert!((colmap_pixel[1] - pixel[1] - 0.5).abs() < 1e-12);
    assert_eq!((k[0], k[1]), (64.0, 48.0));
}

#[test]
fn nerfstudios_ray_through_a_pixel_meets_the_point() {
    let views = small_views();
    let bytes = written(|w| write_transforms_json(w, &views, None));
    let file: serde_json::Value = serde_json::from_slice(&bytes).unwrap();
    let number = |key: &str| file[key].as_f64().unwrap();
    let rows = &file["frames"][1]["transform_matrix"];
    let m = Matrix4::from_fn(|r, c| rows[r][c].as_f64().unwrap());
    let (point, pixel) = point_and_pixel(&views[1]);
    // nerfstudio: coordinates of pixel centres end in .5; the camera looks along −z with y up.
    let (u, v) = (pixel[0] + 0.5, pixel[1] + 0.5);
    let ray =
        Vector4::new((u - number("cx")) / number("fl_x"), -(v - number("cy")) / number("fl_y"), -1.0, 0.0);
    let on_ray = (m * ray).xyz() * 2.0 + m.column(3).xyz();
    assert!((on_ray - point).norm() < 1e-12, "{on_ray} {point}");
    assert_eq!((file["w"].as_u64(), file["h"].as_u64()), (Some(64), Some(48)));
}

#[test]
fn views_of_different_cameras_keep_their_own_intrinsics_in_transforms_json() {
    let mut views = small_views();
    views[1].intrinsics = Pinhole::new(50.0, 51.0, 10.0, 11.0, 32, 24).unwrap();
    let bytes = written(|w| write_transforms_json(w, &views, None));
    let file: serde_json::Value = serde_json::from_slice(&bytes).unwrap();
    assert!(file.get("fl_x").is_none());
    for (read, view) in read_transforms_json(&bytes).unwrap().views.iter().zip(&views) {
        assert_eq!(read.intrinsics, view.intrinsics);
    }
}

#[test]
fn glb_rotates_the_world_by_its_root_node_and_keeps_vertices() {
    let mesh = small_mesh();
    let bytes = written(|w| write_glb_mesh(w, &mesh, &[]));
    let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    let document: serde_json::Value = serde_json::from_slice(&bytes[20..20 + length]).unwrap();
    let columns: Vec<f64> =
        document["nodes"][0]["matrix"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
    let y_up_from_z_up = Matrix4::from_column_slice(&columns);
    // Up (z) becomes glTF's up (y); x stays; the handedness stays.
    assert_eq!(y_up_from_z_up * Vector4::z(), Vector4::y());
    assert_eq!(y_up_from_z_up * Vector4::x(), Vector4::x());
    assert_eq!(y_up_from_z_up.determinant(), 1.0);
    let raw = &bytes[20 + length + 8..];
    for (i, value) in mesh.positions.iter().flatten().enumerate() {
        assert_eq!(raw[4 * i..4 * i + 4], value.to_le_bytes());
    }
}

#[test]
fn a_trajectory_file_without_body_has_an_unknown_body() {
    let t = read_tum(b"# timestamp tx ty tz qx qy qz qw\r\n1.5 1 2 3 0 0 0 1\r\n").unwrap();
    assert_eq!(t.body(), BodyFrame::Other);
    assert_eq!(t.poses()[0].time, Timestamp::from_nanos(1_500_000_000));
    let t = read_euroc_csv(b"#t\n1,1,2,3,1,0,0,0,0,0,0,0,0,0,0,0,0\n").unwrap();
    assert_eq!((t.body(), t.len()), (BodyFrame::Other, 1));
    let times = read_kitti_times(b"0.000000e+00\n1.036224e-01\n").unwrap();
    assert_eq!(times.times[1].nanos(), 103_622_400);
}

#[test]
fn a_ply_of_another_tool_is_read_in_all_three_encodings() {
    let header = |encoding: &str| {
        format!(
            "ply\r\nformat {encoding} 1.0\r\nobj_info by hand\r\ncomment hello\r\nelement camera 1\r\nproperty list uchar float k\r\n\
             element vertex 4\r\nproperty double x\r\nproperty double y\r\nproperty short z\r\nproperty float quality\r\n\
             property ushort red\r\nproperty ushort green\r\nproperty ushort blue\r\nproperty list int short extra\r\n\
             element face 1\r\nproperty uchar flags\r\nproperty list uchar ushort vertex_index\r\nend_header\r\n"
        )
    };
    let mut ascii = header("ascii").into_bytes();
    ascii.extend(b"2 1.5 2.5\n");
    let (mut little, mut big) =
        (header("binary_little_endian").into_bytes(), header("binary_big_endian").into_bytes());
    macro_rules! put {
        ($($value:expr),*) => {$( little.extend($value.to_le_bytes()); big.extend($value.to_be_bytes()); )*};
    }
    put!(2_u8, 1.5_f32, 2.5_f32);
    for i in 0..4_i16 {
        ascii.extend(format!("{i}.25 -{i} {i} 0.5 65535 0 32896 1 -7\n").bytes());
        put!(f64::from(i) + 0.25, -f64::from(i), i, 0.5_f32, 65_535_u16, 0_u16, 32_896_u16, 1_i32, -7_i16);
    }
    ascii.extend(b"9 4 0 1 2 3\n");
    put!(9_u8, 4_u8, 0_u16, 1_u16, 2_u16, 3_u16);
    for bytes in [ascii, little, big] {
        let ply = read_ply(&bytes).unwrap();
        assert_eq!(ply.comments, ["hello"]);
        assert_eq!(ply.cloud.positions[3], [3.25, -3.0, 3.0]);
        assert_eq!(ply.cloud.colors, [[255, 0, 128]; 4]);
        assert_eq!(ply.cloud.confidences, [0.5; 4]);
        assert!(ply.cloud.normals.is_empty());
        assert_eq!(ply.triangles, [[0, 1, 2], [0, 2, 3]]);
    }
}

#[test]
fn colmap_models_of_other_tools_are_read_and_distorted_ones_refused() {
    let cameras = "# Number of cameras: 1\n3 SIMPLE_PINHOLE 64 48 100 32 24\n";
    let images = "# Number of images: 1, mean observations per image: 2\n\
                  9 2 0 0 0 1 2 3 3 a.png\n1.5 2.5 -1 3.5 4.5 17\n";
    let points = "1 0.1 0.2 0.3 1 2 3 0.7 9 0 9 1\n";
    let model =
        read_colmap_bytes(ColmapFormat::Text, cameras.as_bytes(), images.as_bytes(), points.as_bytes())
            .unwrap();
    assert_eq!(model.views[0].intrinsics, Pinhole::new(100.0, 100.0, 31.5, 23.5, 64, 48).unwrap());
    assert_eq!(model.views[0].frame_id, Some(FrameId(8)));
    assert_eq!(model.views[0].world_from_camera.translation, Vector3::new(-1.0, -2.0, -3.0));
    assert_eq!(model.points.positions, [[0.1, 0.2, 0.3]]);
    let distorted = "3 OPENCV 64 48 100 100 32 24 0.1 0 0 0\n";
    let error =
        read_colmap_bytes(ColmapFormat::Text, distorted.as_bytes(), b"", b"").unwrap_err().to_string();
    assert!(error.contains("OPENCV") && error.contains("line 1") && error.contains("undistort"), "{error}");
}

#[test]
fn glb_transforms_of_another_tool_reach_the_vertices() {
    // Our own file with its root node replaced by a scaled, mirrored, moved one of the same length in bytes.
    let mesh = small_mesh();
    let bytes = written(|w| write_glb_mesh(w, &mesh, &[]));
    let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    let mut document: serde_json::Value = serde_json::from_slice(&bytes[20..20 + length]).unwrap();
    document["nodes"] = serde_json::json!([
        { "children": [1], "translation": [0.0, 10.0, 0.0] },
        { "mesh": 0, "scale": [-2.0, 2.0, 2.0] }
    ]);
    let mut json = document.to_string().into_bytes();
    json.resize(json.len().next_multiple_of(4), b' ');
    let mut other = Vec::new();
    let total = bytes.len() - length + json.len();
    other.extend(&bytes[..8]);
    other.extend((total as u32).to_le_bytes());
    other.extend((json.len() as u32).to_le_bytes());
    other.extend(&bytes[16..20]);
    other.extend(&json);
    other.extend(&bytes[20 + length..]);
    let read = read_glb(&other).unwrap().mesh;
    for (a, b) in read.positions.iter().zip(&mesh.positions) {
        // glTF (x, y, z) is VIDAR's (x, −z, y).
        assert_eq!(*a, [-2.0 * b[0], -2.0 * b[2], 2.0 * b[1] + 10.0]);
    }
    // Mirroring by x leaves a normal along y alone (glTF y is VIDAR's z), and turns the corners round.
    assert_eq!(read.normals[1], [0.0, 0.0, 1.0]);
    assert_eq!(read.triangles, [[0, 2, 1]]);
}
