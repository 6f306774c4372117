//! Rows, tables and lists of what a run left behind.

use crate::{Failure, Run};
use vidar_core::{BodyFrame, StampedPose, Timestamp, Trajectory};
use vidar_eval::{TrajectoryEvalConfig, evaluate_trajectory};
use vidar_odometry::{Stage, StageTimes, Status};

/// Prints the figures of one trajectory.
pub fn row(
    name: &str,
    poses: Vec<StampedPose>,
    (first_image, images): (Timestamp, usize),
    times: &[StageTimes],
    truth: &Trajectory,
) -> Result<Trajectory, Failure> {
    let first_secs = (poses[0].time - first_image).as_secs_f64();
    let done = 100.0 * poses.len() as f64 / images as f64;
    let estimate = Trajectory::new(BodyFrame::Imu, poses)?;
    let report = evaluate_trajectory(&estimate, truth, &TrajectoryEvalConfig::default())?;
    let mut millis: Vec<f64> = times.iter().map(|t| 1e3 * t.total().as_secs_f64()).collect();
    let mean = millis.iter().sum::<f64>() / millis.len().max(1) as f64;
    millis.sort_by(f64::total_cmp);
    let percentile = |share: f64| {
        millis.get((millis.len().max(1) - 1) * (100.0 * share) as usize / 100).copied().unwrap_or(f64::NAN)
    };
    let or_nan = |v: Option<f64>| v.unwrap_or(f64::NAN);
    println!(
        "{name:<14} {:>7.4} {:>7.4} {:>7.4} {:>7.2} {:>8.4} {done:>6.1} {first_secs:>6.2} {mean:>7.2} {:>6.2} {:>6.2} {:>6.0} {:>6.1}",
        or_nan(report.ate_se3_m.map(|e| e.rmse)),
        or_nan(report.ate_sim3_m.map(|e| e.rmse)),
        or_nan(report.scale_error),
        or_nan(report.orientation_se3_deg.map(|e| e.rmse)),
        or_nan(report.rpe_metres.map(|e| e.translation_m.rmse)),
        percentile(0.5),
        percentile(0.95),
        peak_megabytes(),
        report.matched_truth_path_m,
    );
    Ok(estimate)
}

/// Median, 95 % quantile and mean of every stage, ms, over the images that passed it; and over the running odometry.
pub fn stages(times: &[StageTimes]) -> String {
    use std::fmt::Write as _;
    let mut text = format!("  {:<12} {:>7} {:>7} {:>7} {:>7}", "stage", "images", "median", "p95", "mean");
    let mut row = |name: &str, mut millis: Vec<f64>| {
        if millis.is_empty() {
            return;
        }
        millis.sort_by(f64::total_cmp);
        let at = |share: f64| millis[((millis.len() - 1) as f64 * share) as usize];
        let mean = millis.iter().sum::<f64>() / millis.len() as f64;
        let (n, median, high) = (millis.len(), at(0.5), at(0.95));
        let _ = write!(text, "\n  {name:<12} {n:>7} {median:>7.3} {high:>7.3} {mean:>7.3}");
    };
    let millis = |secs: std::time::Duration| 1e3 * secs.as_secs_f64();
    let running = |t: &&StageTimes| t.of(Stage::Initialise).is_zero();
    for stage in Stage::ALL {
        let passed = times.iter().filter(|t| running(t) == (stage != Stage::Initialise));
        row(stage.name(), passed.map(|t| millis(t.of(stage))).collect());
    }
    row("all, running", times.iter().filter(running).map(|t| millis(t.total())).collect());
    text
}

/// Processor time per image before and after the start: median, 95 % quantile, largest, ms.
pub fn costs(processor: &[(f64, bool)]) -> String {
    let of = |name: &str, with_state: bool| {
        let mut millis: Vec<f64> =
            processor.iter().filter(|(_, state)| *state == with_state).map(|(secs, _)| 1e3 * secs).collect();
        millis.sort_by(f64::total_cmp);
        let at = |share: f64| {
            millis
                .get((millis.len().max(1) - 1) * (100.0 * share) as usize / 100)
                .copied()
                .unwrap_or(f64::NAN)
        };
        format!("  {name:<26} {:>7} {:>7.2} {:>7.2} {:>7.2}", millis.len(), at(0.5), at(0.95), at(1.0))
    };
    let head = format!(
        "  {:<26} {:>7} {:>7} {:>7} {:>7}",
        "processor ms an image", "images", "median", "p95", "largest"
    );
    [head, of("before the start", false), of("with a state", true)].join("\n")
}

/// Says when things changed.
pub fn tell(run: &Run) {
    let mut last = String::new();
    for output in &run.outputs {
        let now = match &output.status {
            Status::Waiting(progress) => format!("waiting: {progress}"),
            Status::Tracking(tracking) => format!("tracking: {}", tracking.health),
            Status::Lost(reason) => format!("lost: {reason}"),
        };
        if now != last {
            eprintln!("  {} frame {}: {now}", output.time, output.frame_id);
            last = now;
        }
    }
}

pub fn frames(run: &Run) -> String {
    use std::fmt::Write as _;
    let mut text =
        String::from("#time,health,landmarks_found,tried,seeds_found,tried,contradicting,chi2,keyframe\n");
    for (output, tracking) in run.outputs.iter().filter_map(|o| Some((o, o.tracking()?))) {
        let t = &tracking.tracks;
        let _ = writeln!(
            text,
            "{},{},{},{},{},{},{},{:.3},{}",
            output.time,
            tracking.health,
            t.landmarks_found,
            t.landmarks_tried,
            t.seeds_found,
            t.seeds_tried,
            t.contradicting,
            t.chi2_per_dof,
            u8::from(tracking.keyframe.is_some())
        );
    }
    text
}

pub fn tum(trajectory: &Trajectory) -> String {
    use std::fmt::Write as _;
    let mut text = String::new();
    for pose in trajectory.poses() {
        let (t, q) = (pose.world_from_body.translation, pose.world_from_body.rotation.quaternion_xyzw());
        let _ = writeln!(text, "{} {} {} {} {} {} {} {}", pose.time, t.x, t.y, t.z, q[0], q[1], q[2], q[3]);
    }
    text
}

/// Peak resident memory of this process; NaN where the system does not tell.
fn peak_megabytes() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    let kilobytes = line.and_then(|l| l.trim().trim_end_matches("kB").trim().parse::<f64>().ok());
    kilobytes.map_or(f64::NAN, |kb| kb / 1024.0)
}
