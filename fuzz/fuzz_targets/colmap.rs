//! COLMAP models, nerfstudio's transforms.json and depth sidecars; the first byte chooses the file.
#![no_main]

use libfuzzer_sys::fuzz_target;
use vidar_export::{ColmapFormat, DepthSidecar, read_colmap_bytes, read_depth_png, read_transforms_json};

/// One camera of number 1, so that images have something to refer to.
const CAMERA_TEXT: &[u8] = b"1 PINHOLE 64 48 100 110 32 24\n";
const NOTHING: &[u8] = &[0; 8];

fuzz_target!(|bytes: &[u8]| {
    let Some((choice, file)) = bytes.split_first() else { return };
    let model = match choice % 8 {
        0 => read_colmap_bytes(ColmapFormat::Text, file, b"", b""),
        1 => read_colmap_bytes(ColmapFormat::Text, CAMERA_TEXT, file, b""),
        2 => read_colmap_bytes(ColmapFormat::Text, b"", b"", file),
        3 => read_colmap_bytes(ColmapFormat::Binary, file, NOTHING, NOTHING),
        4 => read_colmap_bytes(ColmapFormat::Binary, NOTHING, NOTHING, file),
        5 => {
            // Cameras and images in one input: the length of the first stands in front.
            let Some((length, rest)) = file.split_first() else { return };
            let (cameras, images) = rest.split_at(usize::from(*length).min(rest.len()));
            read_colmap_bytes(ColmapFormat::Binary, cameras, images, NOTHING)
        }
        6 => {
            if let Ok(file) = read_transforms_json(file) {
                assert!(file.views.iter().all(|v| v.world_from_camera.is_finite()));
            }
            drop(DepthSidecar::read(file));
            return;
        }
        _ => return drop(read_depth_png(file, 1000.0)),
    };
    if let Ok(model) = model {
        assert!(model.points.is_consistent());
        assert!(model.views.iter().all(|v| v.world_from_camera.is_finite()));
    }
});
