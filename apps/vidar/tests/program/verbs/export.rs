//! `vidar export`.

use super::text;
use crate::support::{finished, keys, vidar, vidar_in};
use serde_json::Value;
use std::path::Path;

#[test]
fn every_export_is_made_and_an_unknown_one_is_refused_with_the_list() {
    let run = text(&finished().0);
    let folder = tempfile::tempdir().unwrap();
    for format in
        ["colmap", "colmap-text", "nerfstudio", "tum", "kitti", "euroc", "ply", "glb", "textured-glb"]
    {
        let out = folder.path().join(format);
        let json = vidar(&["export", run, "--to", format, "-o", text(&out), "--json"]).ends_with(0).json();
        assert_eq!(keys(&json, 1), ["schema", "made"]);
        let made = json["made"].as_array().unwrap();
        assert!(!made.is_empty(), "{format} made nothing");
        for file in made {
            let length = std::fs::metadata(file.as_str().unwrap()).unwrap();
            assert!(length.is_dir() || length.len() > 0, "{format}: {file} is empty");
        }
    }
    vidar(&["export", run, "--to", "dwg"]).ends_with(2).says(&["dwg", "colmap", "nerfstudio"]);
    vidar_in(folder.path(), &["export", "tum", "--to", "tum"]).ends_with(1).says(&["error[E0207]", "hint:"]);
    assert!(!folder.path().join("tum/export").exists(), "a refused export left a folder");
}

/// The JSON of a GLB.
fn gltf(path: &Path) -> Value {
    let bytes = std::fs::read(path).unwrap();
    let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    serde_json::from_slice(&bytes[20..20 + length]).unwrap()
}

#[test]
fn a_textured_mesh_has_the_triangles_of_the_map_and_the_asked_size() {
    let run = text(&finished().0);
    let folder = tempfile::tempdir().unwrap();
    let mut widths = Vec::new();
    for more in [&["--texture-px", "256"][..], &[], &["--input-size"]] {
        let out = folder.path().join(widths.len().to_string());
        vidar(&[&["export", run, "--to", "textured-glb", "-o", text(&out)], more].concat()).ends_with(0);
        let document = gltf(&out.join("textured.glb"));
        let indices = |p: &Value| {
            let accessor = p["indices"].as_u64().unwrap() as usize;
            document["accessors"][accessor]["count"].as_u64().unwrap()
        };
        let primitives = document["meshes"][0]["primitives"].as_array().unwrap();
        assert!(primitives[0]["attributes"]["TEXCOORD_0"].is_u64(), "{primitives:?}");
        let ply = std::fs::read(Path::new(run).join("map/mesh.ply")).unwrap();
        let header = String::from_utf8_lossy(&ply[..2000]);
        let faces = header.lines().find_map(|l| l.strip_prefix("element face ")).unwrap();
        let all: u64 = primitives.iter().map(indices).sum();
        assert_eq!(all, 3 * faces.parse::<u64>().unwrap());
        assert!(indices(&primitives[0]) * 10 > all * 9, "{} of {all} are textured", indices(&primitives[0]));
        // Columns of the JPEG, from the frame header of a baseline image (T.81, B.2.2).
        let glb = std::fs::read(out.join("textured.glb")).unwrap();
        let start = glb.windows(3).rposition(|w| w == [0xff, 0xd8, 0xff]).unwrap();
        let frame = start + glb[start..].windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
        widths.push(u16::from_be_bytes([glb[frame + 7], glb[frame + 8]]));
    }
    // The run's images have the size of the recording's.
    assert!(widths[0] <= 256 && widths[0] < widths[1] && widths[1] == widths[2], "{widths:?}");
    let refused = |more: &[&str]| vidar(&[&["export", run], more].concat()).ends_with(2);
    refused(&["--to", "textured-glb", "--texture-px", "20"]).says(&["--texture-px", "64", "16384"]);
    refused(&["--to", "glb", "--texture-px", "256"]).says(&["--texture-px", "textured-glb"]);
}

#[test]
fn colmap_gets_tracks_and_images_of_the_input_s_size_on_request() {
    let run = text(&finished().0);
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("large");
    let more = ["--tracks", "--input-size", "-o", text(&out)];
    vidar(&[&["export", run, "--to", "colmap-text"], &more[..]].concat()).ends_with(0);
    let points = std::fs::read_to_string(out.join("sparse/0/points3D.txt")).unwrap();
    let columns = |l: &str| l.split_whitespace().count();
    let (all, seen) = points.lines().filter(|l| !l.starts_with('#')).fold((0, 0), |(all, seen), line| {
        // Eight columns and two for every image: seen twice or more.
        (all + 1, seen + usize::from(columns(line) >= 8 + 4))
    });
    assert!(all > 1000 && seen * 10 > all * 8, "{seen} of {all} points are seen twice");
    let images = std::fs::read_to_string(out.join("sparse/0/images.txt")).unwrap();
    let observations = images.lines().filter(|l| !l.starts_with('#')).skip(1).step_by(2).map(columns);
    let in_tracks: usize = points.lines().filter(|l| !l.starts_with('#')).map(|l| (columns(l) - 8) / 2).sum();
    assert_eq!(observations.sum::<usize>(), 3 * in_tracks, "tracks and observations agree");
    let cameras = std::fs::read_to_string(out.join("sparse/0/cameras.txt")).unwrap();
    assert!(cameras.contains("PINHOLE 160 "), "{cameras}");
    for image in std::fs::read_dir(out.join("images")).unwrap().flatten() {
        let png = std::fs::read(image.path()).unwrap();
        assert_eq!(png[16..20], 160_u32.to_be_bytes(), "its width");
    }
    vidar(&["export", run, "--to", "tum", "--tracks"]).ends_with(2).says(&["--tracks", "colmap"]);
    vidar(&["export", run, "--to", "ply", "--input-size"]).ends_with(2).says(&["--input-size", "nerfstudio"]);
}
