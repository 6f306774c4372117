//! Invalid, truncated and random files, and paths that cannot be written.
#![allow(clippy::unwrap_used, clippy::panic)] // Helpers of tests may stop at the first surprise, as tests may.

mod allocations;
#[path = "../common/mod.rs"]
mod common;
mod samples;

use allocations::assert_small_allocations;
use common::*;
use proptest::prelude::*;
use samples::{NO_RECORDS, samples};
use std::fs::{self, OpenOptions};
use std::io::Write;
use std::path::Path;
use vidar_core::{Image, MetricDepth, PointCloud, Timestamp};
use vidar_export::*;

/// An error of a reader has a position, an expected and a found value.
fn assert_has_position(name: &str, error: &ExportError) {
    match error {
        ExportError::Malformed { place, expected, found, .. } => {
            assert!(!place.is_empty() && !expected.is_empty() && !found.is_empty(), "{name}: {error}");
        }
        ExportError::Unsupported { place, feature, .. } => {
            assert!(!place.is_empty() && !feature.is_empty(), "{name}: {error}");
        }
        other => panic!("{name}: {other}"),
    }
    assert!(error.to_string().len() < 2000, "{name}: {error}");
}

#[test]
fn a_file_truncated_at_any_byte_is_an_error_with_a_position() {
    for sample in samples() {
        (sample.read)(&sample.bytes).unwrap_or_else(|e| panic!("{}: {e}", sample.name));
        let mut refused = 0;
        for end in 0..sample.bytes.len() {
            match (sample.read)(&sample.bytes[..end]) {
                Ok(()) => {
                    assert!(!sample.truncation_is_detected, "{} cut at byte {end} was accepted", sample.name)
                }
                Err(error) => {
                    assert_has_position(sample.name, &error);
                    refused += 1;
                }
            }
        }
        // Text may be cut between lines, within a comment or through the digits of its last number; not elsewhere.
        assert!(refused > 10, "{}: {refused} of {}", sample.name, sample.bytes.len());
    }
    assert_small_allocations();
}

#[test]
fn no_changed_byte_makes_a_reader_panic_or_reserve_memory() {
    for sample in samples() {
        let mut bytes = sample.bytes.clone();
        for at in 0..bytes.len() {
            let original = bytes[at];
            for value in [0, b'9', b'-', b'"', 0x7F, 0xFF, original ^ 1, original ^ 0x80] {
                bytes[at] = value;
                if let Err(error) = (sample.read)(&bytes) {
                    assert_has_position(sample.name, &error);
                }
            }
            bytes[at] = original;
        }
    }
    assert_small_allocations();
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 128, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn random_bytes_after_a_valid_beginning_never_panic(
        keep in 0.0..1.0,
        garbage in proptest::collection::vec(any::<u8>(), 0..64),
    ) {
        for sample in samples() {
            let mut bytes = sample.bytes;
            bytes.truncate((bytes.len() as f64 * keep) as usize);
            bytes.extend(&garbage);
            if let Err(error) = (sample.read)(&bytes) {
                assert_has_position(sample.name, &error);
            }
        }
        assert_small_allocations();
    }
}

fn refused<T: std::fmt::Debug>(result: Result<T, ExportError>, words: &[&str]) {
    let error = result.unwrap_err();
    assert_has_position("refused", &error);
    let text = error.to_string();
    for word in words {
        assert!(text.contains(word), "{word:?} is missing in: {text}");
    }
    assert_small_allocations();
}

#[test]
fn impossible_counts_cost_no_memory() {
    let vertex = "property float x\nproperty float y\nproperty float z\n";
    for encoding in ["ascii", "binary_little_endian", "binary_big_endian"] {
        for count in ["1000000000", "18446744073709551615"] {
            let file =
                format!("ply\nformat {encoding} 1.0\nelement vertex {count}\n{vertex}end_header\n1 2 3\n");
            refused(read_ply(file.as_bytes()), &["element vertex", count]);
            let file = format!(
                "ply\nformat {encoding} 1.0\nelement nothing {count}\nelement vertex 0\n{vertex}end_header\n"
            );
            refused(read_ply(file.as_bytes()), &["element nothing", "properties"]);
        }
        let list = format!(
            "ply\nformat {encoding} 1.0\nelement strange 1\nproperty list uint double l\nend_header\n"
        );
        let body: &[u8] = if encoding == "ascii" { b"4294967295 1 2 3 4 5" } else { &[0xFF; 30] };
        refused(read_ply(&[list.as_bytes(), body].concat()), &["strange 0", "4294967295"]);
    }
    refused(read_ply(b"ply\nformat ascii 1.0\nelement vertex -1\n"), &["header line 3", "-1"]);

    let huge = u64::MAX.to_le_bytes();
    for files in
        [[&huge, NO_RECORDS, NO_RECORDS], [NO_RECORDS, &huge, NO_RECORDS], [NO_RECORDS, NO_RECORDS, &huge]]
    {
        let read = read_colmap_bytes(ColmapFormat::Binary, files[0], files[1], files[2]);
        refused(read, &["18446744073709551615", "byte 8"]);
    }

    // 16-bit grey of 16384 × 16384 with no pixels behind it, checksum right.
    let mut png = vec![0x89, b'P', b'N', b'G', 13, 10, 26, 10, 0, 0, 0, 13];
    let header = [b'I', b'H', b'D', b'R', 0, 0, 0x40, 0, 0, 0, 0x40, 0, 16, 0, 0, 0, 0];
    png.extend(header);
    png.extend(crc32(&header).to_be_bytes());
    refused(read_depth_png(&png, 1000.0), &["depth PNG"]);
}

fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0, |crc, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |c, _| if c & 1 == 1 { 0xEDB8_8320 ^ (c >> 1) } else { c >> 1 })
    })
}

fn glb_of(document: &str, binary: &[u8]) -> Vec<u8> {
    let mut json = document.as_bytes().to_vec();
    json.resize(json.len().next_multiple_of(4), b' ');
    let total = 20 + json.len() + 8 + binary.len();
    let mut file = b"glTF\x02\0\0\0".to_vec();
    file.extend((total as u32).to_le_bytes());
    file.extend((json.len() as u32).to_le_bytes());
    file.extend(b"JSON");
    file.extend(json);
    file.extend((binary.len() as u32).to_le_bytes());
    file.extend(b"BIN\0");
    file.extend(binary);
    file
}

#[test]
fn a_glb_with_wrong_or_repeated_data_is_refused() {
    let glb = |nodes: &str, roots: &str, count: u64, length: u64| {
        let document = format!(
            r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":{roots}}}],"nodes":{nodes},
            "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"mode":0}}]}}],
            "accessors":[{{"bufferView":0,"componentType":5126,"count":{count},"type":"VEC3"}}],
            "bufferViews":[{{"buffer":0,"byteLength":{length}}}],"buffers":[{{"byteLength":{length}}}]}}"#
        );
        read_glb(&glb_of(&document, &[0; 1200]))
    };
    let one = r#"[{"mesh":0}]"#;
    assert_eq!(glb(one, "[0]", 100, 1200).unwrap().mesh.positions.len(), 100);
    refused(glb(one, "[0]", 101, 1200), &["accessors[0]", "101"]);
    refused(glb(one, "[0]", u64::MAX, 1200), &["accessors[0]"]);
    refused(glb(one, "[0]", 101, u64::MAX), &["bufferViews[0]"]);
    refused(glb(one, "[0,0]", 1, 1200), &["nodes[0]", "twice"]);
    refused(glb(r#"[{"children":[0]}]"#, "[0]", 1, 1200), &["nodes[0]", "twice"]);
    refused(glb(r#"[{"mesh":7}]"#, "[0]", 1, 1200), &["nodes[0]", "mesh 7"]);
    // A hundred nodes of one mesh: more vertices than the file has bytes.
    let many = vec![r#"{"mesh":0}"#; 100].join(",");
    let roots: Vec<String> = (0..100).map(|i| i.to_string()).collect();
    refused(glb(&format!("[{many}]"), &format!("[{}]", roots.join(",")), 100, 1200), &["repeated"]);
    // A chain of nodes deeper than any tool makes.
    let chain: Vec<String> = (1..=100).map(|i| format!(r#"{{"children":[{i}]}}"#)).collect();
    refused(glb(&format!("[{},{{}}]", chain.join(",")), "[0]", 1, 1200), &["levels"]);
}

#[test]
fn malformed_text_is_reported_with_its_line() {
    refused(read_tum(b"# c\n1 0 0 0 0 0 0 1\n2 0 0 nan 0 0 0 1\n"), &["line 3", "nan"]);
    refused(read_tum(b"1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n"), &["line 2", "after 1.000000000"]);
    refused(read_tum(b"1 0 0 0 0 0 0 2\n"), &["line 1", "length 2"]);
    refused(read_tum(b"1 0 0 0 0 0 0 0\n"), &["line 1", "unit quaternion"]);
    refused(read_tum(b"1 0 0 0 0 0 0\n"), &["line 1", "8 columns", "7"]);
    refused(read_tum(b"1 0 0 0\n\xFF"), &["line 2", "UTF-8"]);
    refused(read_tum(b"# world_from_body, body = cam\n"), &["line 1", "cam"]);
    refused(read_euroc_csv(b"1.5,0,0,0,1,0,0,0\n"), &["line 1", "1.5", "integer nanoseconds"]);
    let times = KittiTimes { body: small_trajectory().body(), times: vec![Timestamp::from_nanos(1)] };
    refused(read_kitti(b"", &times), &["1 too few"]);
    let line = "1 0 0 0 0 1 0 0 0 0 1 0\n";
    refused(read_kitti(line.repeat(2).as_bytes(), &times), &["line 2", "one more"]);
    refused(read_kitti(b"1 0 0 0 0 1 0 0 0 0 -1 0\n", &times), &["line 1", "rotation"]);
    refused(
        read_colmap_bytes(ColmapFormat::Text, b"", b"1 1 0 0 0 0 0 0 5 a.png\n\n", b""),
        &["image 1", "camera 5"],
    );
    refused(
        read_colmap_bytes(ColmapFormat::Text, b"# Number of cameras: 2\n", b"", b""),
        &["2 records", "0"],
    );
    let scaled = r#"{"fl_x":1,"cx":1,"cy":1,"w":2,"h":2,"frames":[{"file_path":"a",
        "transform_matrix":[[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]}]}"#;
    refused(read_transforms_json(scaled.as_bytes()), &["frames[0]", "rigid"]);
    let k1 = scaled.replace('2', "1").replace("\"frames\"", "\"k1\":0.1,\"frames\"");
    refused(read_transforms_json(k1.as_bytes()), &["frames[0]", "k1 = 0.1", "undistort"]);
    refused(
        read_transforms_json(scaled.replace("\"cx\":1,", "").replace("2,0", "1,0").as_bytes()),
        &["frames[0]"],
    );
}

#[test]
fn values_that_a_format_cannot_hold_are_refused_before_a_byte_is_written() {
    let mut nan = small_mesh();
    nan.positions[1][2] = f32::NAN;
    let mut short = small_mesh();
    short.colors.pop();
    let mut loose = small_mesh();
    loose.triangles[0][1] = 3;
    for (mesh, words) in [(nan, "vertex 1"), (short, "2 of them for 3"), (loose, "only 3 vertices")] {
        let mut bytes = Vec::new();
        for error in [write_ply_mesh(&mut bytes, &mesh, &[]), write_glb_mesh(&mut bytes, &mesh, &[])] {
            let text = error.unwrap_err().to_string();
            assert!(text.contains(words), "{text}");
        }
        assert!(bytes.is_empty());
    }
    let dir = tempfile::tempdir().unwrap();
    let refuse = |change: fn(&mut Vec<ExportView>), words: &str| {
        let mut views = small_views();
        change(&mut views);
        let text_model = write_colmap(dir.path(), ColmapFormat::Text, &views, &PointCloud::default(), &[]);
        let error = text_model.unwrap_err().to_string();
        assert!(error.contains(words), "{error}");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0);
    };
    refuse(|v| v[1].image_name = "two words.png".into(), "binary format");
    refuse(|v| v[1].image_name = v[0].image_name.clone(), "twice");
    refuse(|v| v[1].frame_id = v[0].frame_id, "twice");
    refuse(|v| v[0].image_name = "a\0b".into(), "printable");
    refuse(|v| v[0].intrinsics.fx = 0.0, "fx");
    refuse(|v| v[0].world_from_camera.translation.x = f64::INFINITY, "not finite");
    let depth = MetricDepth::new(Image::filled(2, 2, 1.0));
    assert!(write_depth_png(Vec::new(), &depth, f64::NAN).is_err());
}

#[cfg(target_os = "linux")]
#[test]
fn every_writer_reports_a_full_device() {
    let (trajectory, mesh, views) = (small_trajectory(), small_mesh(), small_views());
    let depth = MetricDepth::new(Image::filled(3, 3, 1.0));
    let sidecar = DepthSidecar::new(1000.0, &views[0].intrinsics, vec![]);
    let full = || OpenOptions::new().write(true).open("/dev/full").unwrap();
    let results = [
        write_tum(full(), &trajectory, ""),
        write_euroc_csv(full(), &trajectory, ""),
        write_kitti(full(), &trajectory),
        write_kitti_times(full(), &trajectory, ""),
        write_ply_mesh(full(), &mesh, &[]),
        write_ply_cloud(full(), &cloud_of(&mesh), &[]),
        write_glb_mesh(full(), &mesh, &[]),
        write_glb_cloud(full(), &cloud_of(&mesh), &[]),
        write_transforms_json(full(), &views, None),
        write_depth_png(full(), &depth, 1000.0).map(drop),
        sidecar.write(full()),
    ];
    for (i, result) in results.into_iter().enumerate() {
        match result {
            Err(ExportError::Write { source, .. }) => {
                assert_eq!(source.kind(), std::io::ErrorKind::StorageFull, "writer {i}");
            }
            other => panic!("writer {i}: {other:?}"),
        }
    }
}

#[test]
fn a_model_at_an_invalid_path_is_reported_with_the_path() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("eine Datei ä");
    fs::File::create(&file).unwrap().write_all(b"x").unwrap();
    let below: &Path = &file.join("sparse");
    let write = write_colmap(below, ColmapFormat::Binary, &small_views(), &PointCloud::default(), &[]);
    for error in [write.unwrap_err(), read_colmap(below).unwrap_err()] {
        assert!(matches!(error, ExportError::File { .. }), "{error}");
        assert!(error.to_string().contains(&below.display().to_string()), "{error}");
    }
}
