//! Parity with the official DA3-Streaming, stage by stage, on recorded inputs and outputs.
//!
//! The recordings are not part of this repository; without them every test here says that it was skipped. Tolerances are
//! those of the recordings' manifest.

mod golden;

use self::golden::{Golden, all_within, apart, cameras, chunk_points, folder, point_map, recorded_chunk};
use vidar_align::coupled::Kernel;
use vidar_align::streaming::*;
use vidar_core::{LieGroup, Sim3};

#[test]
fn chunk_tables_are_those_of_the_official_code() {
    let Some(folder) = folder() else { return };
    let table: serde_json::Value =
        serde_json::from_slice(&std::fs::read(folder.join("indices.json")).unwrap()).unwrap();
    let number = |v: &serde_json::Value| v.as_u64().unwrap() as usize;
    let rows = table["chunk_indices"].as_array().unwrap();
    assert!(rows.len() > 10);
    for row in rows {
        let chunks =
            chunk_ranges(number(&row["n"]), number(&row["chunk_size"]), number(&row["overlap"])).unwrap();
        let expected: Vec<(usize, usize)> =
            row["chunks"].as_array().unwrap().iter().map(|c| (number(&c[0]), number(&c[1]))).collect();
        let found: Vec<(usize, usize)> = chunks.iter().map(|c| (c.frames.start, c.frames.end)).collect();
        assert_eq!(found, expected, "{row}");
        // The official code loses the poses of a single chunk; ours belong to it.
        if chunks.len() > 1 {
            let owners: Vec<(usize, usize)> = row["pose_owner_first_last"]
                .as_array()
                .unwrap()
                .iter()
                .map(|c| (number(&c[0]), number(&c[1]) + 1))
                .collect();
            let found: Vec<(usize, usize)> = chunks.iter().map(|c| (c.owned.start, c.owned.end)).collect();
            assert_eq!(found, owners, "{row}");
        }
    }
}

#[test]
fn closed_forms_and_losses_are_met() {
    let Some(golden) = Golden::open("steps") else { return };
    let (source, target) = (golden.points("src"), golden.points("tgt"));
    let (weights, ones) = (golden.get("w"), vec![1.0; source.len()]);
    let check = |x: &[_], y: &[_], w: &[f64], method, stem: &str| {
        let found = weighted_similarity(x, y, w, method).unwrap();
        let expected = golden.similarities(stem)[0];
        assert!(apart(&found, &expected) < 1e-9, "{stem} {:e}", apart(&found, &expected));
    };
    check(&source, &target, &weights, AlignMethod::Sim3, "sim3_");
    check(&source, &target, &weights, AlignMethod::Se3, "se3_");
    check(&source, &target, &ones, AlignMethod::Sim3, "plain_");
    check(&source, &golden.points("mirror_tgt"), &weights, AlignMethod::Sim3, "mirror_");
    check(&golden.points("planar_src"), &golden.points("planar_tgt"), &weights, AlignMethod::Sim3, "planar_");
    let residuals = golden.get("huber_r");
    for (i, r) in residuals.iter().enumerate() {
        assert!(
            (Kernel::Huber { k: 0.1 }.loss_of_length(*r) - golden.get("huber_loss_delta0.1")[i]).abs()
                < 1e-12
        );
        // The recorded weights went through f32.
        assert!(
            (Kernel::Huber { k: 0.1 }.weight_of_length(*r) - golden.get("huber_w_delta0.1")[i]).abs() < 1e-7
        );
    }
}

#[test]
fn overlaps_are_aligned_step_by_step_as_in_f64() {
    for name in ["clean", "outlier20", "unequal_b", "empty_frame", "big"] {
        let Some(golden) = Golden::open(&format!("align_{name}")) else { return };
        let (target, source) = (point_map(&golden, "1"), point_map(&golden, "2"));
        for (method, stem) in [(AlignMethod::Sim3, "sim3"), (AlignMethod::Se3, "se3")] {
            let config = IrlsConfig { compat: Compat::Reference, ..Default::default() };
            let fit = align_overlap(&target, &source, method, 1.0, &config).unwrap();
            assert_eq!(fit.pairs, golden.get("sel_weights").len(), "{name}");
            let expected = golden.similarities(&format!("{stem}.f64_trace."));
            for (k, step) in expected.iter().enumerate() {
                // The recording repeats the last estimate once the reference has stopped.
                let found = fit.trace.trace.get(k).or(fit.trace.trace.last()).unwrap().target_from_source;
                assert!(apart(&found, step) < 1e-9, "{name} {stem} {k}: {:e}", apart(&found, step));
            }
            for library in ["numpy", "numba", "torch"] {
                let shipped = golden.similarities(&format!("{stem}.{library}."))[0];
                let found = fit.target_from_source;
                assert!((found.scale - shipped.scale).abs() < 1e-6, "{name} {stem} {library}");
                assert!((found.translation - shipped.translation).amax() < 5e-5, "{name} {stem} {library}");
            }
        }
    }
}

#[test]
fn chains_and_loop_constraints_compose_alike() {
    let Some(golden) = Golden::open("chain") else { return };
    let sum = accumulate(&golden.similarities("seq_"));
    all_within(&sum, &golden.similarities("cum_"), 1e-12, "cum");
    let found = loop_constraint(&golden.similarities("Sa_")[0], &golden.similarities("Sb_")[0]);
    all_within(&[found], &golden.similarities("Sab_"), 1e-12, "ab");
    let moved: Vec<_> = golden.points("points").iter().map(|p| sum[3].act(p)).collect();
    for (a, b) in moved.iter().zip(golden.points("applied_cum3")) {
        assert!((a - b).norm() < 1e-11);
    }
}

#[test]
fn depth_becomes_the_same_points() {
    let Some(golden) = Golden::open("unproject") else { return };
    let shape = golden.shape("depth");
    let (height, width) = (shape[1], shape[2]);
    let depth = golden.f32("depth");
    let expected = golden.points("points_f64");
    for (i, (camera, pose)) in cameras(&golden, "", width, height).iter().enumerate() {
        let n = width * height;
        let found = unproject(&depth[i * n..(i + 1) * n], camera, pose);
        for (a, b) in found.iter().zip(&expected[i * n..]) {
            // Extrinsics are f32, so their rotation is one to 1e-7 only.
            assert!((a - b).norm() < 1e-5 * (1.0 + b.norm()), "{i}: {a} {b}");
        }
    }
}

#[test]
fn scales_from_depths_are_met() {
    let Some(golden) = Golden::open("scale_precompute") else { return };
    let (d1, c1) = (golden.f32("depth1"), golden.f32("conf1"));
    let (d2, c2) = (golden.f32("depth2"), golden.f32("conf2"));
    let scale = |method, compat| depth_scale((&d1, &c1), (&d2, &c2), method, compat).unwrap();
    let weighted = scale(ScaleMethod::Weighted, Compat::Reference);
    assert!((weighted.scale - 1.247_737_5).abs() < 1e-5, "{weighted:?}");
    assert!((weighted.quality - 0.137_025_67).abs() < 1e-5, "{weighted:?}");
    // Samples are drawn by another generator; the consensus and its least squares are the same.
    for method in [ScaleMethod::Ransac, ScaleMethod::Auto] {
        let found = scale(method, Compat::Reference);
        assert!(
            (found.scale - 1.229_302).abs() < 2e-4 && (found.quality - 0.900_79).abs() < 5e-3,
            "{found:?}"
        );
    }
    // What the reference meant: the true scale is 1.23.
    let median = scale(ScaleMethod::Weighted, Compat::Off);
    assert!((median.scale - 1.23).abs() < 5e-3, "{median:?}");
}

#[test]
fn loops_are_detected_and_suppressed_alike() {
    let Some(golden) = Golden::open("loop_detect") else { return };
    let descriptors = golden.f32("descriptors");
    let dimension = golden.shape("descriptors")[1];
    let text = std::fs::read(folder().unwrap().join("loop_detect.json")).unwrap();
    let table: serde_json::Map<String, serde_json::Value> = serde_json::from_slice(&text).unwrap();
    for (key, rows) in table {
        let part: Vec<f64> = key
            .split('_')
            .map(|p| p.trim_start_matches(|c: char| c.is_alphabetic()).parse().unwrap())
            .collect();
        let config = LoopDetection {
            min_similarity: part[0] as f32,
            suppress_frames: part[1] as usize,
            top_k: part[2] as usize,
            compat: Compat::Reference,
            ..Default::default()
        };
        let found: Vec<(usize, usize)> =
            detect_loops(&descriptors, dimension, &config).iter().map(|p| (p.later, p.earlier)).collect();
        // The official list may hold a pair twice, once per direction, when the last bit differs.
        let mut expected: Vec<(usize, usize)> = Vec::new();
        for row in rows.as_array().unwrap() {
            let pair = (row[0].as_u64().unwrap() as usize, row[1].as_u64().unwrap() as usize);
            if !expected.contains(&pair) {
                expected.push(pair);
            }
        }
        let sorted = |mut v: Vec<_>| {
            v.sort_unstable();
            v
        };
        if config.suppress_frames > 0 {
            assert_eq!(found, expected, "{key}");
        }
        assert_eq!(sorted(found), sorted(expected), "{key}");
    }
}

#[test]
fn pose_graphs_converge_to_the_same_relatives() {
    for name in ["ring20", "ring20_bigscale", "ring20_falseloop"] {
        let Some(golden) = Golden::open(&format!("posegraph_{name}")) else { return };
        let chain = golden.similarities("seq_");
        let loops: Vec<LoopConstraint> = golden
            .get("loop_i")
            .iter()
            .zip(golden.get("loop_j"))
            .zip(golden.similarities("loop_"))
            .map(|((a, b), b_from_a)| LoopConstraint { a: *a as usize, b: b as usize, b_from_a })
            .collect();
        let outcome = optimise_chain(&chain, &loops, &PoseGraphConfig::default()).unwrap();
        let before = golden.get("f64.cost_before");
        assert_eq!(outcome.steps.len(), before.len(), "{name}");
        assert!((outcome.steps[0].cost_before / before[0] - 1.0).abs() < 1e-9, "{name}");
        // Step by step as long as the cost still falls; at the bottom the last bits decide what is accepted.
        let falling = before.windows(2).take_while(|c| c[1] < c[0] * (1.0 - 1e-6)).count();
        for (k, step) in outcome.steps.iter().take(falling).enumerate() {
            let same = (step.cost_before / before[k] - 1.0).abs() < 1e-5;
            assert!(same && step.is_accepted, "{name} {k}: {step:?} {}", before[k]);
        }
        assert!(falling >= 3, "{name}");
        all_within(&outcome.previous_from_next, &golden.similarities("f64.out_"), 1e-7, name);
        // The shipped f32 solver; the recording's own f64 run is 2.0e-4 from it. With a false loop f32 is chaotic.
        if name != "ring20_falseloop" {
            all_within(&outcome.previous_from_next, &golden.similarities("cpp.out_"), 2.1e-4, name);
        }
    }
}

#[test]
fn a_whole_run_ends_in_the_same_poses() {
    let Some(input) = Golden::open("e2e_inputs") else { return };
    let golden = Golden::open("e2e_sim3_numpy").unwrap();
    let chunks = chunk_ranges(40, 12, 6).unwrap();
    let config = IrlsConfig { compat: Compat::Reference, ..Default::default() };
    let align = |target: &PointMap, source: &PointMap| {
        align_overlap(target, source, AlignMethod::Sim3, 1.0, &config).unwrap().target_from_source
    };
    let chain: Vec<Sim3> = (1..chunks.len())
        .map(|k| {
            let (previous, next) = (format!("chunk{}", k - 1), format!("chunk{k}"));
            let len = chunks[k - 1].frames.len();
            align(&chunk_points(&input, &previous, len - 6..len), &chunk_points(&input, &next, 0..6))
        })
        .collect();
    all_within(&chain, &golden.similarities("seq_before_"), 1e-4, "before");
    // Loop chunks: four frames around each end, found at frames (38, 2) and (33, 8) of this recording.
    let mut loops = Vec::new();
    for (frames_a, frames_b) in [(36..40, 0..4), (31..35, 6..10)] {
        let stem = format!("loop_{}_{}_{}_{}", frames_a.start, frames_a.end, frames_b.start, frames_b.end);
        assert!(input.has(&format!("{stem}.depth")));
        let chunk_of = |frame: usize| chunks.iter().rposition(|c| c.frames.start <= frame).unwrap();
        let pair = FramePair { later: frames_a.start + 2, earlier: frames_b.start + 2, similarity: 1.0 };
        let window = loop_windows(&[pair], &chunks, 2, Compat::Reference)[0].clone();
        assert_eq!((window.frames_a.clone(), window.frames_b.clone()), (frames_a.clone(), frames_b.clone()));
        let within = |frames: &std::ops::Range<usize>, chunk: usize| {
            let start = chunks[chunk].frames.start;
            chunk_points(&input, &format!("chunk{chunk}"), frames.start - start..frames.end - start)
        };
        let (a, b) = (chunk_of(pair.later), chunk_of(pair.earlier));
        assert_eq!((window.a, window.b), (a, b));
        let a_from_loop = align(&within(&frames_a, a), &chunk_points(&input, &stem, 0..4));
        let b_from_loop = align(&within(&frames_b, b), &chunk_points(&input, &stem, 4..8));
        loops.push(LoopConstraint { a, b, b_from_a: loop_constraint(&a_from_loop, &b_from_loop) });
    }
    let constraints: Vec<Sim3> = loops.iter().map(|l| l.b_from_a).collect();
    all_within(&constraints, &golden.similarities("loop_"), 1e-3, "loops");
    let after = optimise_chain(&chain, &loops, &PoseGraphConfig::default()).unwrap().previous_from_next;
    all_within(&after, &golden.similarities("seq_after_"), 1e-3, "after");
    let sum = accumulate(&after);
    let expected = golden.get("camera_poses");
    for (k, chunk) in chunks.iter().enumerate() {
        let first_from_chunk = if k == 0 { Sim3::IDENTITY } else { sum[k - 1] };
        let poses = cameras(&input, &format!("chunk{k}"), 28, 14);
        for frame in chunk.owned.clone() {
            let world_from_camera =
                first_from_chunk.transform_pose(&poses[frame - chunk.frames.start].1).matrix();
            let golden = nalgebra::Matrix4::from_row_slice(&expected[frame * 16..frame * 16 + 16]);
            assert!((world_from_camera - golden).amax() < 1e-3, "frame {frame}");
        }
    }
    // Depth leaves the run times its chunk's scale.
    let depth = input.f32("chunk3.depth");
    let expected = golden.f32("npz_frame20_depth");
    for (d, e) in depth[2 * 392..3 * 392].iter().zip(expected) {
        assert!((f64::from(*d) * sum[2].scale - f64::from(e)).abs() < 1e-3 * f64::from(e).max(1.0));
    }
}

#[test]
fn gross_errors_on_one_side_leave_the_robust_scale_within_a_fifth_of_a_percent() {
    for (name, reference_error) in [("outlier20", -0.035), ("big", -0.016)] {
        let Some(golden) = Golden::open(&format!("align_{name}")) else { return };
        let (target, source) = (point_map(&golden, "1"), point_map(&golden, "2"));
        let truth = golden.get("gt_s")[0];
        let config = IrlsConfig { compat: Compat::Reference, ..Default::default() };
        let theirs = align_overlap(&target, &source, AlignMethod::Sim3, 1.0, &config).unwrap();
        let error = theirs.target_from_source.scale / truth - 1.0;
        assert!((error - reference_error).abs() < 2e-3, "{name}: the reference is {error} off");
        let mut pairs = vidar_align::overlap::PointPairs::default();
        let shared = target.points.len().min(source.points.len());
        let tau = 0.1;
        for i in 0..shared {
            let (y, x) = (target.points[i], source.points[i]);
            let (a, b) = (target.confidence[i], source.confidence[i]);
            let usable = a > tau && b > tau && y.iter().chain(x.iter()).all(|v| v.is_finite());
            if usable {
                // The recording holds points only; their distance stands for their depth.
                pairs.push(x, y, x.norm(), y.norm(), f64::from((a * b).sqrt()));
            }
        }
        let ours = vidar_align::overlap::fit_overlap(&pairs, &Default::default()).unwrap();
        let error = ours.target_from_source.scale / truth - 1.0;
        assert!(error.abs() < 2e-3, "{name}: {error}");
        assert!(error.abs() < 0.25 * reference_error.abs());
    }
}

#[test]
fn the_machine_chains_the_recorded_run_as_the_official_code_does() {
    let Some(input) = Golden::open("e2e_inputs") else { return };
    let golden = Golden::open("e2e_sim3_numpy").unwrap();
    let expected = accumulate(&golden.similarities("seq_before_"));
    for (compat, tolerance) in [(Compat::Reference, 1e-4), (Compat::Off, 0.05)] {
        let config = vidar_align::AlignerConfig { compat, ..Default::default() };
        let mode = vidar_align::CouplingMode::Da3Streaming;
        let mut machine = vidar_align::Aligner::new(mode, &config).unwrap();
        let chunks = chunk_ranges(40, 12, 6).unwrap();
        for (k, chunk) in chunks.iter().enumerate() {
            let prediction = recorded_chunk(&input, k, chunk.frames.start);
            machine.push(vidar_align::ChunkObservation { prediction, frames: Vec::new() }).unwrap();
        }
        let placement = machine.finish();
        let found: Vec<Sim3> = placement.chunks.iter().skip(1).map(|c| c.world_from_chunk).collect();
        all_within(&found, &expected, tolerance, "chain");
        for view in &placement.views {
            let owner = chunks.iter().position(|c| c.owned.contains(&view.frame_id.index())).unwrap();
            assert_eq!(view.owner.index(), owner, "frame {}", view.frame_id);
        }
    }
}
