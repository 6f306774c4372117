//! The machine in every mode, on a room of which everything is known.

#![allow(clippy::unwrap_used)] // helpers of tests are test code, though not marked so

mod flat;

use flat::*;
use vidar_align::aligner::Guard;
use vidar_align::streaming::chunk_ranges;
use vidar_align::{Aligner, AlignerConfig, CouplingMode, Placement, Verdict};
use vidar_core::{LieGroup, Se3, umeyama_sim3};

fn run(mode: CouplingMode, truth: &[Se3], odometry: Option<&[Se3]>, model: Model, seed: u64) -> Placement {
    let mut noise = Noise::new(seed);
    let mut machine = Aligner::new(mode, &AlignerConfig::default()).unwrap();
    for (k, range) in chunk_ranges(truth.len(), 12, 4).unwrap().into_iter().enumerate() {
        let prediction = predict(truth, range.frames, k as u32, model, &mut noise);
        machine.push(observe(prediction, odometry, none)).unwrap();
    }
    machine.finish()
}

#[test]
fn an_exact_model_gives_the_exact_world_in_every_metric_mode() {
    let truth = laps(40, 1.0);
    for mode in [
        CouplingMode::PoseConditioned,
        CouplingMode::GroundTruth,
        CouplingMode::Hybrid,
        CouplingMode::Coupled,
    ] {
        let placement = run(mode, &truth, Some(&truth), EXACT, 1);
        assert!(placement.is_metric && placement.mode == mode);
        assert_eq!(placement.views.len(), truth.len(), "{mode}");
        let error = absolute_error(&placement, &truth);
        assert!(error < 1e-4, "{mode}: {error}");
        assert!(placement.chunks.iter().all(|c| c.verdict.is_usable()));
        // The last chunk is short: its motion alone does not tell its scale to 3 %.
        let unexpected = placement.guards.iter().find(|(g, _)| *g != Guard::ScaleUnobservable);
        assert_eq!(unexpected, None, "{mode}");
        // A frame of an overlap belongs to the later chunk.
        let owners: Vec<u32> = placement.views.iter().map(|v| v.owner.0).collect();
        assert!(owners.windows(2).all(|o| o[0] <= o[1]) && owners[8] == 1, "{owners:?}");
    }
}

#[test]
fn without_anchors_the_world_is_right_up_to_one_similarity() {
    let truth = laps(40, 1.0);
    for mode in [CouplingMode::Da3Streaming, CouplingMode::PoseFree, CouplingMode::Coupled] {
        let placement = run(mode, &truth, None, EXACT, 2);
        assert!(!placement.is_metric);
        let (placed, exact): (Vec<_>, Vec<_>) = placement
            .views
            .iter()
            .map(|v| (v.world_from_camera.translation, truth[v.frame_id.index()].translation))
            .unzip();
        let onto = umeyama_sim3(&placed, &exact).unwrap();
        let worst = placed.iter().zip(&exact).map(|(p, e)| (onto.act(p) - e).norm()).fold(0.0, f64::max);
        assert!(worst < 1e-4, "{mode}: {worst}");
        for view in &placement.views {
            let chunk = placement.chunk(view.owner).unwrap();
            assert!((view.metres_per_unit / chunk.world_from_chunk.scale - 1.0).abs() < 1e-12);
        }
    }
}

#[test]
fn anchors_change_nothing_where_the_mode_does_not_use_them() {
    let truth = laps(30, 1.0);
    let with = run(CouplingMode::PoseFree, &truth, Some(&truth), REAL, 3);
    let without = run(CouplingMode::PoseFree, &truth, None, REAL, 3);
    assert_eq!(with.views, without.views);
    assert!(with.guards.of(Guard::NoOverlap) == 0 && with.chunks[0].verdict == Verdict::Chained);
}

#[test]
fn the_same_input_gives_the_same_bits() {
    let truth = laps(40, 1.5);
    let odometry = drifting(&truth, 1.0, &mut Noise::new(9));
    for mode in CouplingMode::ALL {
        let once = run(mode, &truth, Some(&odometry), REAL, 4);
        let again = run(mode, &truth, Some(&odometry), REAL, 4);
        assert_eq!(once.views, again.views, "{mode}");
    }
}
