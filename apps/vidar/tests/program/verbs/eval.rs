//! `vidar eval`.

use super::text;
use crate::support::{finished, keys, shared, vidar};

#[test]
fn bounds_missed_end_with_5_and_bounds_kept_with_0() {
    let run = text(&finished().0);
    vidar(&["eval", run, "--fail-below", "f@0.10=0.01", "--fail-above", "chamfer=5"]).ends_with(0);
    vidar(&["eval", run, "--fail-below", "f@0.10=0.9999"]).ends_with(5).says(&[
        "error[E0501]",
        "f@0.10",
        "0.9999",
    ]);
    vidar(&["eval", run, "--fail-above", "speed=1"]).ends_with(5).says(&["speed", "there are: "]);
    let ran = vidar(&["eval", run, "--json", "--fail-below", "f@0.10=0.9999"]).ends_with(5);
    assert_eq!(
        keys(&ran.json(), 1),
        ["schema", "kind", "scores", "report"],
        "one object, also when a bound is missed"
    );
}

#[test]
fn eval_scores_trajectories_and_surfaces_and_a_file_equals_itself() {
    let run = &finished().0;
    let (tum, ply) = (run.join("trajectory/metric_camera.tum"), run.join("map/points.ply"));
    let json = vidar(&["eval", text(&tum), text(&tum), "--json"]).ends_with(0).json();
    assert_eq!(json["kind"], "trajectory");
    assert!(json["scores"]["ate"].as_f64().unwrap() < 1e-9);
    assert!(json["scores"]["scale"].as_f64().unwrap() < 1e-9);
    let json = vidar(&["eval", text(&ply), text(&ply), "--json"]).ends_with(0).json();
    assert_eq!(json["kind"], "surface");
    assert_eq!(json["scores"]["f@0.05"], 1.0);
    assert!(vidar(&["eval", text(&tum), text(&tum)]).ends_with(0).stdout.contains("ATE SE(3)"));
}

#[test]
fn options_named_in_hints_of_eval_exist() {
    let help = vidar(&["eval", "--help"]).ends_with(0).stdout;
    let file = |name: &str, rows: String| {
        let path = shared().root.join(name);
        std::fs::write(&path, rows).unwrap();
        path
    };
    let tum = |scale: f64| -> String {
        (0..20)
            .map(|i| format!("{} {i} {} 0 0 0 0 1\n", 1.6e9 * scale + f64::from(i) * scale, i * i))
            .collect()
    };
    let (plain, millis) = (file("plain.tum", tum(1.0)), file("millis.tum", tum(1e3)));
    let kitti =
        file("poses.kitti", (0..20).map(|i| format!("1 0 0 {i} 0 1 0 {} 0 0 1 0\n", i * i)).collect());
    let times = file("times.txt", (0..20).map(|i| format!("{}\n", 1_600_000_000 + i)).collect());
    let empty = file("empty.tum", String::new());
    for (estimate, code) in [(&plain, 0), (&millis, 0), (&kitti, 1), (&empty, 1)] {
        let ran = vidar(&["eval", text(estimate), text(&plain)]).ends_with(code);
        let named: Vec<&str> = ran
            .stderr
            .split(|c: char| !(c.is_ascii_alphanumeric() || c == '-'))
            .filter(|word| word.starts_with("--"))
            .collect();
        assert!(!named.is_empty(), "{}", ran.stderr);
        assert!(named.iter().all(|option| help.contains(option)), "{named:?} in\n{}", ran.stderr);
    }
    // The named options remove the cause.
    let body = ["--trajectory-body", "imu"];
    let ran = vidar(&[&["eval", text(&plain), text(&plain)], &body[..]].concat()).ends_with(0);
    assert!(!ran.stderr.contains("trajectory-body"), "{}", ran.stderr);
    let ran = vidar(&["eval", text(&kitti), text(&kitti), "--timestamps", text(&times), "--json"]);
    assert_eq!(ran.ends_with(0).json()["report"]["matched"], 20);
}
