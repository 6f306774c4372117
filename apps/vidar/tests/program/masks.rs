//! Masks: what is black in them is in no depth image and in no map.

use crate::support::{files_under, run_on, shared};
use serde_json::Value;
use std::path::{Path, PathBuf};
use vidar::core::{FrameImage, Image, MetricDepth};
use vidar::export_formats::write_depth_png;

/// Columns and rows of the recording's images, and the part of each that is masked.
const SIZE: (usize, usize) = (160, 104);
const MASKED: (std::ops::Range<usize>, std::ops::Range<usize>) = (40..90, 30..80);

fn is_masked(x: usize, y: usize) -> bool {
    MASKED.0.contains(&x) && MASKED.1.contains(&y)
}

/// A grey PNG, black where the mask is zero.
fn encoded(mask: &Image<f32>) -> Vec<u8> {
    let mut bytes = Vec::new();
    write_depth_png(&mut bytes, &MetricDepth::new(mask.clone()), 255.0).unwrap();
    bytes
}

/// A folder of masks of the recording's images, each called by `name`.
fn masks(folder: &str, size: (usize, usize), name: impl Fn(&str) -> String) -> PathBuf {
    let out = shared().root.join(folder);
    std::fs::create_dir_all(&out).unwrap();
    let bytes = encoded(&Image::from_fn(size.0, size.1, |x, y| if is_masked(x, y) { 0.0 } else { 1.0 }));
    for image in files_under(&shared().sequence.join("mav0/cam0/data")) {
        std::fs::write(out.join(name(image.trim_end_matches(".png"))), &bytes).unwrap();
    }
    out
}

fn run(name: &str, more: &[&str]) -> (PathBuf, Value) {
    let out = shared().root.join(name);
    let all = [&["-q", "--json", "--set", "geometry.max_width_px=160"], more].concat();
    let json = run_on(&shared().sequence, &out, &all).ends_with(0).json();
    (out, json["result"].clone())
}

/// Pixels with depth well inside the mask, and of all others the share.
fn depth_inside_and_outside(out: &Path) -> (usize, f64) {
    let (mut inside, mut outside, mut all) = (0, 0, 0usize);
    for name in files_under(&out.join("depth")).iter().filter(|n| n.ends_with(".png")) {
        let bytes = std::fs::read(out.join("depth").join(name)).unwrap();
        let limits = vidar::dataset::decode::ImageLimits::default();
        let FrameImage::Gray16(depth) = vidar::dataset::decode::decode_image(&bytes, &limits).unwrap() else {
            panic!("{name} has no 16 bits")
        };
        // The view is the camera without its distortion: a few pixels of the border may lie on either side.
        let (width, height) = (depth.width(), depth.height());
        for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
            let (u, v) = (x * SIZE.0 / width, y * SIZE.1 / height);
            if (u.saturating_sub(8)..=u + 8).all(|u| (v.saturating_sub(8)..=v + 8).all(|v| is_masked(u, v))) {
                inside += usize::from(depth[(x, y)] > 0);
            } else if !(u.saturating_sub(8)..=u + 8)
                .any(|u| (v.saturating_sub(8)..=v + 8).any(|v| is_masked(u, v)))
            {
                all += 1;
                outside += usize::from(depth[(x, y)] > 0);
            }
        }
    }
    assert!(all > 0, "no depth image in {}", out.display());
    (inside, outside as f64 / all as f64)
}

#[test]
fn what_is_black_in_a_mask_has_no_depth_whatever_the_source() {
    let folder = masks("masks", SIZE, |stem| format!("{stem}.png.png"));
    let flag = ["--masks", folder.to_str().unwrap()];
    for source in ["auto", "stereo", "da3-nano"] {
        let geometry = ["--geometry", source];
        let (without, _) = run(&format!("{source} unmasked"), &geometry);
        let (with, _) = run(&format!("{source} masked"), &[&geometry[..], &flag].concat());
        let (seen, before) = depth_inside_and_outside(&without);
        let (left, after) = depth_inside_and_outside(&with);
        assert!(seen > 1000, "{source}: without masks there is depth at {seen} pixels");
        assert_eq!(left, 0, "{source}: depth at masked pixels");
        // What every other view sees behind the mask is lost: of images this small a sixth, by stereo alone.
        assert!(after > 0.75 * before, "{source}: {after} of the other pixels have depth, before {before}");
        let readme = std::fs::read_to_string(with.join("README.txt")).unwrap();
        assert!(readme.contains("of 20 of 20 images"), "{readme}");
    }
}

#[test]
fn a_masked_run_is_resumed_with_the_same_bits_but_not_with_other_masks() {
    let folder = masks("masks stems", SIZE, |stem| format!("{stem}.png"));
    let flags =
        ["--masks", folder.to_str().unwrap(), "--geometry", "auto", "--set", "output.keep_chunks=true"];
    let (out, _) = run("masked kept", &flags);
    let results = || -> Vec<(String, Vec<u8>)> {
        let names = files_under(&out).into_iter().filter(|n| n.starts_with("depth") || n.starts_with("map/"));
        names.map(|n| (n.clone(), std::fs::read(out.join(n)).unwrap())).collect()
    };
    let first = results();
    let again = [&flags[..], &["--resume"]].concat();
    run("masked kept", &again);
    assert!(first == results(), "resumed");
    let log = || std::fs::read_to_string(out.join("log.jsonl")).unwrap();
    assert!(log().contains("\"is_reused\":true"));
    // Masks of the same names that hide nothing: the predictions are made anew.
    let white = encoded(&Image::filled(SIZE.0, SIZE.1, 1.0));
    for name in files_under(&folder) {
        std::fs::write(folder.join(name), &white).unwrap();
    }
    let before = log().matches("\"is_reused\":false").count();
    run("masked kept", &again);
    assert!(log().matches("\"is_reused\":false").count() > before, "predicted anew");
    assert!(depth_inside_and_outside(&out).0 > 1000);
}

#[test]
fn masks_that_do_not_fit_are_refused_with_the_reason() {
    let refused = |name: &str, folder: &Path, code: i32, words: &[&str]| {
        let flags = ["--masks", folder.to_str().unwrap()];
        run_on(&shared().sequence, &shared().root.join(name), &flags).ends_with(code).says(words);
    };
    let small = masks("masks small", (80, 52), |stem| format!("{stem}.png"));
    refused("masked small", &small, 2, &["80x52", "160x104", "masks small"]);
    let other = masks("masks other", SIZE, |stem| format!("mask of {stem}.png"));
    refused("masked other", &other, 2, &["no mask of any of the 20 images", ".png.png or "]);
    refused("masked nowhere", &shared().root.join("no such folder"), 4, &["no such folder"]);
}
