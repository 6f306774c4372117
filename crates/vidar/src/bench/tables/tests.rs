//! Tables of made-up rows.

use super::*;
use crate::bench::row::TrajectoryScores;
use crate::config::Layered;

pub(in super::super) fn request(modes: Vec<CouplingMode>) -> BenchRequest {
    BenchRequest {
        kind: BenchKind::Euroc,
        root: None,
        synthetic: None,
        sequences: Vec::new(),
        modes,
        trajectories: false,
        layered: Layered::defaults().unwrap(),
        out: "out".into(),
        command: Vec::new(),
    }
}

fn row(sequence: &str, mode: CouplingMode, f10: f64, log_scale: f64) -> BenchRow {
    BenchRow {
        sequence: sequence.into(),
        mode,
        f10: Some(f10),
        f05: Some(f10 / 2.0),
        f10_rigid: Some(f10 - 0.1),
        f10_free: Some(f10 + 0.1),
        trajectory: TrajectoryScores {
            ate_sim3_m: Some(0.02),
            log_scale: Some(log_scale),
            ..TrajectoryScores::default()
        },
        keyframes: 10,
        seconds: 5.0,
        ..BenchRow::default()
    }
}

#[test]
fn tables_hold_valid_runs_and_count_the_failed_ones() {
    let (pf, hybrid) = (CouplingMode::PoseFree, CouplingMode::Hybrid);
    let request = request(vec![pf, hybrid]);
    let names = ["V1_01".to_owned(), "V1_02".to_owned()];
    let failed = BenchRow { failure: Some("E0305 nothing".into()), ..row("V1_02", hybrid, 0.0, 0.0) };
    let rows = [
        row("V1_01", pf, 0.4, 0.5),
        row("V1_02", pf, 0.2, -0.3),
        row("V1_01", hybrid, 0.7, 0.01),
        BenchRow {
            f10: None,
            f05: None,
            f10_rigid: None,
            f05_rigid: None,
            f10_free: None,
            trajectory: TrajectoryScores::default(),
            ..failed
        },
    ];
    let text = Cells::new(&request, &names, &rows, &[]).markdown();
    // The rigid fit comes first, without the paper's numbers.
    let (rigid, bounded) = (text.find("| V1_01 | 0.300 | 0.600 |"), text.find("| V1_01 | 0.400 [0.583]"));
    assert!(rigid.is_some() && rigid < bounded, "{text}");
    assert!(text.contains("| F@0.10 rigid | 0.2000 | 0.6000 |"), "{text}");
    assert!(text.contains("| V1_01 | 0.400 [0.583] | 0.700 |"), "{text}");
    assert!(text.contains("| V1_02 | 0.200 [0.025] | failed |"), "{text}");
    assert!(text.contains("| mean (valid) | 0.300 [0.405] (2/2) | 0.700 [0.676] (1/2) |"), "{text}");
    assert!(text.contains("| mean \\|ln s\\| | 0.4000 [0.458] | 0.0100 |"), "{text}");
    assert!(text.contains("| ΔF | 0.1000 [0.256] | 0.1000 |"), "{text}");
    assert!(text.contains("| V1_02 | hybrid | E0305 nothing |"), "{text}");
    assert_eq!((median(&[3.0, 1.0]), median(&[])), (Some(2.0), None));
    assert_eq!(deviation(&[1.0]), None);
}
