//! The exact bytes of small files, so that changes of a format are noticed. Binary files are composed field by field
//! from each format's specification, not copied from a run.

use crate::common::*;
use vidar_core::{PointCloud, TriangleMesh};
use vidar_export::*;

fn text(bytes: Vec<u8>) -> String {
    String::from_utf8(bytes).unwrap()
}

#[test]
fn tum_is_unchanged() {
    let expected = "\
# world_from_body, body = camera0
# vidar test
# timestamp tx ty tz qx qy qz qw
1403636579.763555584 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 1.000000000
1403636579.813555456 1.000000000 -2.500000000 0.250000000 0.000000000 0.000000000 0.707106781 0.707106781
";
    assert_eq!(text(written(|w| write_tum(w, &small_trajectory(), "vidar test"))), expected);
}

#[test]
fn euroc_csv_is_unchanged() {
    let expected = "\
# world_from_body, body = camera0
#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []
1403636579763555584,0.000000000,0.000000000,0.000000000,1.000000000,0.000000000,0.000000000,0.000000000
1403636579813555456,1.000000000,-2.500000000,0.250000000,0.707106781,0.000000000,0.000000000,0.707106781
";
    assert_eq!(text(written(|w| write_euroc_csv(w, &small_trajectory(), ""))), expected);
}

#[test]
fn kitti_and_its_times_are_unchanged() {
    let lines = text(written(|w| write_kitti(w, &small_trajectory())));
    let second: Vec<f64> = lines.lines().nth(1).unwrap().split(' ').map(|t| t.parse().unwrap()).collect();
    let expected = [0.0, -1.0, 0.0, 1.0, 1.0, 0.0, 0.0, -2.5, 0.0, 0.0, 1.0, 0.25];
    assert!(second.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{second:?}");
    let first = "1.000000000000e0 0.000000000000e0 0.000000000000e0 0.000000000000e0 \
                 0.000000000000e0 1.000000000000e0 0.000000000000e0 0.000000000000e0 \
                 0.000000000000e0 0.000000000000e0 1.000000000000e0 0.000000000000e0";
    assert_eq!(lines.lines().next().unwrap(), first);
    let times = text(written(|w| write_kitti_times(w, &small_trajectory(), "")));
    assert_eq!(times, "# world_from_body, body = camera0\n1403636579.763555584\n1403636579.813555456\n");
}

#[test]
fn ply_is_unchanged() {
    let mesh = small_mesh();
    let mut expected = b"ply
format binary_little_endian 1.0
comment normals unit; colours sRGB; confidence 0..1
comment source test run
element vertex 3
property float x
property float y
property float z
property float nx
property float ny
property float nz
property uchar red
property uchar green
property uchar blue
property float confidence
element face 1
property list uchar int vertex_indices
end_header
"
    .to_vec();
    for i in 0..3 {
        for value in mesh.positions[i].iter().chain(&mesh.normals[i]) {
            expected.extend(value.to_le_bytes());
        }
        expected.extend(mesh.colors[i]);
        expected.extend(mesh.confidences[i].to_le_bytes());
    }
    expected.extend([3, 0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0]);
    // A line break in a comment must not become a header line.
    assert_eq!(written(|w| write_ply_mesh(w, &mesh, &["source\ntest run".into()])), expected);
    let bare = PointCloud::from_positions(vec![[1.0, 2.0, 3.0]]);
    let file = written(|w| write_ply_cloud(w, &bare, &[]));
    let end = b"element vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n\
                \x00\x00\x80\x3F\x00\x00\x00\x40\x00\x00\x40\x40";
    assert!(file.ends_with(end));
}

#[test]
fn glb_is_unchanged() {
    let mesh = TriangleMesh { normals: vec![], confidences: vec![], ..small_mesh() };
    let json = concat!(
        r#"{"asset":{"version":"2.0","generator":"vidar","extras":{"#,
        r#""frame":"vertices as in the map's world; node \"world\" turns its z into y, glTF's up","#,
        r#""comments":["test"]}},"scene":0,"scenes":[{"nodes":[0]}],"nodes":[{"name":"world","#,
        r#""matrix":[1.0,0.0,0.0,0.0,0.0,0.0,-1.0,0.0,0.0,1.0,0.0,0.0,0.0,0.0,0.0,1.0],"mesh":0}],"#,
        r#""meshes":[{"primitives":[{"indices":2,"attributes":{"POSITION":0,"COLOR_0":1},"material":0,"mode":4}]}],"#,
        r#""materials":[{"pbrMetallicRoughness":{"baseColorFactor":[1.0,1.0,1.0,1.0],"metallicFactor":0.0,"#,
        r#""roughnessFactor":1.0},"doubleSided":true,"extensions":{"KHR_materials_unlit":{}}}],"#,
        r#""extensionsUsed":["KHR_materials_unlit"],"#,
        r#""accessors":[{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3","#,
        r#""min":[0.0,0.0,-0.25],"max":[1.0,2.0,0.5]},"#,
        r#"{"bufferView":1,"componentType":5123,"count":3,"type":"VEC4","normalized":true},"#,
        r#"{"bufferView":2,"componentType":5125,"count":3,"type":"SCALAR"}],"#,
        r#""bufferViews":[{"buffer":0,"byteOffset":0,"byteLength":36,"target":34962},"#,
        r#"{"buffer":0,"byteOffset":36,"byteLength":24,"target":34962},"#,
        r#"{"buffer":0,"byteOffset":60,"byteLength":12,"target":34963}],"buffers":[{"byteLength":72}]}"#
    );
    let mut json = json.as_bytes().to_vec();
    json.resize(json.len().next_multiple_of(4), b' ');
    let mut expected = b"glTF\x02\0\0\0".to_vec();
    expected.extend((20 + json.len() as u32 + 8 + 72).to_le_bytes());
    expected.extend((json.len() as u32).to_le_bytes());
    expected.extend(b"JSON");
    expected.extend(json);
    expected.extend(72_u32.to_le_bytes());
    expected.extend(b"BIN\0");
    for value in mesh.positions.iter().flatten() {
        expected.extend(value.to_le_bytes());
    }
    // sRGB bytes as linear light of 16 bits: v/255 below 0.04045 is divided by 12.92, 128 is 0.215861.
    let linear = [[65_535, 0, 20], [0, 14_146, 40], [139, 159, 179_u16]];
    for color in linear {
        for channel in [color[0], color[1], color[2], 65_535] {
            expected.extend(channel.to_le_bytes());
        }
    }
    for index in [0_u32, 1, 2] {
        expected.extend(index.to_le_bytes());
    }
    assert_eq!(written(|w| write_glb_mesh(w, &mesh, &["test".into()])), expected);
}

#[test]
fn an_empty_cloud_is_a_valid_file_in_every_format() {
    let empty = PointCloud::default();
    assert!(read_ply(&written(|w| write_ply_cloud(w, &empty, &[]))).unwrap().cloud.is_empty());
    let glb = written(|w| write_glb_cloud(w, &empty, &[]));
    assert!(!String::from_utf8_lossy(&glb).contains("BIN\0"));
    assert!(read_glb(&glb).unwrap().mesh.positions.is_empty());
    let dir = tempfile::tempdir().unwrap();
    write_colmap(dir.path(), ColmapFormat::Binary, &[], &empty, &[]).unwrap();
    assert_eq!(read_colmap(dir.path()).unwrap(), ColmapModel::default());
}

#[test]
fn colmap_text_is_unchanged() {
    let dir = tempfile::tempdir().unwrap();
    write_colmap(dir.path(), ColmapFormat::Text, &small_views(), &cloud_of(&small_mesh()), &[]).unwrap();
    let read = |name: &str| std::fs::read_to_string(dir.path().join(name)).unwrap();
    assert_eq!(
        read("cameras.txt"),
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n\
         # Number of cameras: 1\n1 PINHOLE 64 48 100 110 32 24\n"
    );
    let images = read("images.txt");
    let mut lines = images.lines().skip(3);
    assert_eq!(lines.next(), Some("# Number of images: 2"));
    assert!(lines.next().unwrap().ends_with(" 1 images/a.png"));
    assert_eq!(lines.next(), Some(""));
    // The inverse of a quarter turn about z at (1, −2.5, 0.25).
    let second: Vec<&str> = lines.next().unwrap().split(' ').collect();
    assert_eq!((second[0], second[8], second[9]), ("8", "1", "images/b.png"));
    let half = 0.5_f64.sqrt();
    for (token, expected) in second[1..8].iter().zip([half, 0.0, 0.0, -half, 2.5, 1.0, -0.25]) {
        assert!((token.parse::<f64>().unwrap() - expected).abs() < 1e-15, "{second:?}");
    }
    assert_eq!(
        read("points3D.txt"),
        "# 3D point list with one line of data per point:\n\
         #   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n# Number of points: 3\n\
         1 0 0 0 255 0 1 -1\n2 1 0 0.5 0 128 2 -1\n3 0 2 -0.25 7 8 9 -1\n"
    );
}

#[test]
fn colmap_binary_is_unchanged() {
    let dir = tempfile::tempdir().unwrap();
    let views = &small_views()[..1];
    let cloud =
        PointCloud { positions: vec![[1.0, 0.0, 0.5]], colors: vec![[1, 2, 3]], ..PointCloud::default() };
    write_colmap(dir.path(), ColmapFormat::Binary, views, &cloud, &[]).unwrap();
    let read = |name: &str| std::fs::read(dir.path().join(name)).unwrap();
    let reals = |values: &[f64]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let number = |value: u64| value.to_le_bytes().to_vec();
    let id = |value: u32| value.to_le_bytes().to_vec();
    let cameras = [number(1), id(1), id(1), number(64), number(48), reals(&[100.0, 110.0, 32.0, 24.0])];
    assert_eq!(read("cameras.bin"), cameras.concat());
    let images = read("images.bin");
    let name = b"images/a.png\0".to_vec();
    let expected =
        [number(1), id(1), reals(&[1.0, 0.0, 0.0, 0.0]), reals(&[0.0; 3]), id(1), name, number(0)].concat();
    // −0 and 0 are both an origin; the sign bit is not specified.
    assert_eq!(images.len(), expected.len());
    assert!(images.iter().zip(&expected).all(|(a, b)| a == b || (*a == 0x80 && *b == 0)));
    let points = [number(1), number(1), reals(&[1.0, 0.0, 0.5]), vec![1, 2, 3], reals(&[-1.0]), number(0)];
    assert_eq!(read("points3D.bin"), points.concat());
}

#[test]
fn transforms_json_is_unchanged() {
    let file = text(written(|w| write_transforms_json(w, &small_views()[..1], Some("points.ply"))));
    let compact: String = file.split_whitespace().collect();
    let expected = concat!(
        r#"{"camera_model":"OPENCV","fl_x":100.0,"fl_y":110.0,"cx":32.0,"cy":24.0,"w":64,"h":48,"#,
        r#""k1":0.0,"k2":0.0,"p1":0.0,"p2":0.0,"#,
        r#""applied_transform":[[1.0,0.0,0.0,0.0],[0.0,1.0,0.0,0.0],[0.0,0.0,1.0,0.0]],"#,
        r#""ply_file_path":"points.ply","frames":[{"file_path":"images/a.png","transform_matrix":"#,
        r#"[[1.0,0.0,0.0,0.0],[0.0,-1.0,0.0,0.0],[0.0,0.0,-1.0,0.0],[0.0,0.0,0.0,1.0]],"#,
        r#""frame_id":0,"timestamp_ns":1403636579763555584}]}"#
    );
    assert_eq!(compact.replace("-0.0", "0.0"), expected);
}

#[test]
fn a_depth_png_of_another_encoder_is_read_and_the_written_header_is_the_same() {
    // Pillow 12: uint16 [[0, 1, 1000], [65535, 2500, 256]].
    let pillow = [
        0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a, 0x00, 0x00, 0x00, 0x0d, 0x49, 0x48, 0x44, 0x52, 0x00,
        0x00, 0x00, 0x03, 0x00, 0x00, 0x00, 0x02, 0x10, 0x00, 0x00, 0x00, 0x00, 0xe8, 0x8f, 0xe5, 0x85, 0x00,
        0x00, 0x00, 0x16, 0x49, 0x44, 0x41, 0x54, 0x78, 0x9c, 0x63, 0x60, 0x60, 0x60, 0x60, 0x64, 0x7e, 0xc1,
        0xf0, 0xff, 0x3f, 0xe7, 0x11, 0x46, 0x06, 0x00, 0x14, 0xda, 0x03, 0xb9, 0x57, 0x40, 0x11, 0xcb, 0x00,
        0x00, 0x00, 0x00, 0x49, 0x45, 0x4e, 0x44, 0xae, 0x42, 0x60, 0x82,
    ];
    let depth = read_depth_png(&pillow, 1000.0).unwrap();
    assert!(depth.image()[(0, 0)].is_nan());
    assert_eq!(depth.image().data()[1..], [0.001, 1.0, 65.535, 2.5, 0.256]);
    let mut ours = Vec::new();
    write_depth_png(&mut ours, &depth, 1000.0).unwrap();
    // Signature and header (size, 16-bit grey, not interlaced, checksum) are the same bytes.
    assert_eq!(ours[..33], pillow[..33]);
    assert_eq!(read_depth_png(&ours, 1000.0).unwrap().image().data()[1..], depth.image().data()[1..]);
}
