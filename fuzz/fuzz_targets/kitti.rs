//! KITTI trajectories and rows of 4x4 matrices.
#![no_main]

use libfuzzer_sys::fuzz_target;
use std::path::Path;
use vidar_dataset::parse::{self, Source};

fuzz_target!(|bytes: &[u8]| {
    let source = Source { path: Path::new("fuzz"), bytes };
    if let Ok(file) = parse::kitti_poses(&source) {
        assert!(file.poses.iter().all(|p| p.world_from_body.is_finite()));
    }
    if let Ok((poses, _)) = parse::matrix_poses(&source) {
        assert!(poses.iter().flatten().all(|p| p.is_finite()));
    }
});
