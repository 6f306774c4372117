//! Runs the odometry over recorded or rendered sequences and prints a row of figures per sequence.
//!
//! ```text
//! cargo run --release -p vidar-odometry --example evaluate -- [--mono] [--start S] [--secs S] [--quiet]
//!     [--trajectory FILE] [--frames FILE] [--set KEY=VALUE]... SEQUENCE...
//! ```
//!
//! A sequence is any folder with images, IMU readings and ground truth that `vidar-dataset` reads. Figures: ATE after the best
//! rigid motion and after the best similarity, |ln s|, relative error per metre, share of frames with a pose, seconds
//! from the first image to the first metric pose, processor time per image (decoding left out), peak memory. `--set` changes
//! a number of the odometry's configuration; `--frames` writes what became of the tracks in every image.

#![allow(clippy::print_stdout, clippy::print_stderr)] // a program

use std::path::{Path, PathBuf};
use vidar_core::{BodyFrame, Duration, Health, SensorEvent, StampedPose, Trajectory};
use vidar_dataset::OpenOptions;
use vidar_eval::{TrajectoryEvalConfig, evaluate_trajectory};
use vidar_odometry::{ImuUse, Odometry, OdometryConfig, OdometryOutput, Status};

type Failure = Box<dyn std::error::Error>;

#[derive(Default)]
struct Options {
    sequences: Vec<PathBuf>,
    mono: bool,
    start_secs: f64,
    secs: Option<f64>,
    verbose: bool,
    trajectory: Option<PathBuf>,
    frames: Option<PathBuf>,
    settings: Vec<(String, f64)>,
}

fn options() -> Result<Options, Failure> {
    let mut found = Options::default();
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        let mut value = || args.next().ok_or(format!("{arg} needs a value"));
        match arg.as_str() {
            "--mono" => found.mono = true,
            "--verbose" => found.verbose = true,
            "--start" => found.start_secs = value()?.parse()?,
            "--secs" => found.secs = Some(value()?.parse()?),
            "--set" => {
                let text = value()?;
                let (key, number) = text.split_once('=').ok_or("--set needs KEY=VALUE")?;
                found.settings.push((key.to_owned(), number.parse()?));
            }
            "--frames" => found.frames = Some(value()?.into()),
            "--trajectory" => found.trajectory = Some(value()?.into()),
            other if other.starts_with("--") => return Err(format!("unknown flag {other}").into()),
            path => found.sequences.push(path.into()),
        }
    }
    if found.sequences.is_empty() { Err("no sequence was named".into()) } else { Ok(found) }
}

fn main() -> Result<(), Failure> {
    let options = options()?;
    println!(
        "{:<14} {:>7} {:>7} {:>7} {:>7} {:>8} {:>6} {:>6} {:>7} {:>6} {:>6} {:>6} {:>6}",
        "sequence",
        "SE3 m",
        "Sim3 m",
        "|ln s|",
        "rot deg",
        "RPE m/m",
        "done %",
        "first",
        "ms mean",
        "ms med",
        "ms p95",
        "MB",
        "path m"
    );
    for path in &options.sequences {
        evaluate(path, &options)?;
    }
    Ok(())
}

/// Everything that one run left behind.
struct Run {
    outputs: Vec<OdometryOutput>,
    millis: Vec<f64>,
    poses: Vec<StampedPose>,
}

fn evaluate(path: &Path, options: &Options) -> Result<(), Failure> {
    let open = OpenOptions {
        start: (options.start_secs > 0.0).then(|| Duration::from_secs_f64(options.start_secs)),
        end: options.secs.map(|s| Duration::from_secs_f64(options.start_secs + s)),
        ..OpenOptions::default()
    };
    let dataset = vidar_dataset::open(path, &open)?;
    let name =
        path.file_name().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into_owned());
    let run = run(&dataset, options)?;
    if options.verbose {
        tell(&run);
    }
    if let Some(file) = &options.frames {
        std::fs::write(file, frames(&run))?;
    }
    let Some(first_image) = dataset.images.first().map(|i| i.time) else { return Err("no images".into()) };
    if run.poses.len() < 3 {
        println!("{name:<14} no trajectory: {} poses", run.poses.len());
        return Ok(());
    }
    let first_secs = (run.poses[0].time - first_image).as_secs_f64();
    let done = 100.0 * run.poses.len() as f64 / dataset.images.len() as f64;
    let estimate = Trajectory::new(BodyFrame::Imu, run.poses)?;
    if let Some(file) = &options.trajectory {
        std::fs::write(file, tum(&estimate))?;
    }
    let truth = dataset.ground_truth.as_ref().ok_or("no ground truth")?;
    let report = evaluate_trajectory(&estimate, truth, &TrajectoryEvalConfig::default())?;
    let mut millis = run.millis;
    // The system may tell processor time in steps of its clock tick (4 ms): then only the mean is exact.
    let mean = millis.iter().sum::<f64>() / millis.len().max(1) as f64;
    millis.sort_by(f64::total_cmp);
    let percentile = |share: f64| millis[((millis.len() - 1) as f64 * share) as usize];
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
    Ok(())
}

fn run(dataset: &vidar_dataset::Dataset, options: &Options) -> Result<Run, Failure> {
    let imu = if options.mono { ImuUse::Off } else { ImuUse::Auto };
    let mut config = OdometryConfig { imu, ..OdometryConfig::default() };
    for (key, number) in &options.settings {
        set(&mut config, key, *number)?;
    }
    let mut odometry = Odometry::new(&dataset.rig, dataset.camera, &config)?;
    let mut run = Run { outputs: Vec::new(), millis: Vec::new(), poses: Vec::new() };
    let mut since_image = 0.0;
    for event in dataset.events() {
        let event = event?;
        if matches!(event, SensorEvent::GroundTruth { .. } | SensorEvent::Depth { .. }) {
            continue;
        }
        let clock = processor_secs();
        let output = odometry.push(event)?;
        since_image += processor_secs() - clock;
        if let Some(output) = output {
            run.millis.push(1e3 * since_image);
            since_image = 0.0;
            keep(&mut run, output, options.mono);
        }
    }
    for output in odometry.finish() {
        keep(&mut run, output, options.mono);
    }
    Ok(run)
}

/// Changes one number of the configuration.
fn set(config: &mut OdometryConfig, key: &str, number: f64) -> Result<(), Failure> {
    match key {
        "max_landmarks" => config.max_landmarks = number as usize,
        "max_keyframes" => config.max_keyframes = number as usize,
        "iterations" => config.iterations = number as usize,
        "pixel_noise_px" => config.pixel_noise_px = number,
        "gyro_noise_factor" => config.gyro_noise_factor = number,
        "accel_noise_factor" => config.accel_noise_factor = number,
        other => return Err(format!("no number called {other} in the configuration").into()),
    }
    Ok(())
}

fn keep(run: &mut Run, output: OdometryOutput, mono: bool) {
    if let Some(tracking) = output.tracking()
        && (mono || tracking.health != Health::ScaleUnknown)
    {
        run.poses.push(StampedPose { time: output.time, world_from_body: tracking.state.world_from_body });
    }
    run.outputs.push(output);
}

/// Says when things changed.
fn tell(run: &Run) {
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

fn frames(run: &Run) -> String {
    use std::fmt::Write as _;
    let mut text =
        String::from("#time,health,landmarks_found,tried,young_found,tried,contradicting,chi2,keyframe\n");
    for (output, tracking) in run.outputs.iter().filter_map(|o| Some((o, o.tracking()?))) {
        let t = &tracking.tracks;
        let _ = writeln!(
            text,
            "{},{},{},{},{},{},{},{:.3},{}",
            output.time,
            tracking.health,
            t.landmarks_found,
            t.landmarks_tried,
            t.young_found,
            t.young_tried,
            t.contradicting,
            t.chi2_per_dof,
            u8::from(tracking.keyframe.is_some())
        );
    }
    text
}

fn tum(trajectory: &Trajectory) -> String {
    use std::fmt::Write as _;
    let mut text = String::new();
    for pose in trajectory.poses() {
        let (t, q) = (pose.world_from_body.translation, pose.world_from_body.rotation.quaternion_xyzw());
        let _ = writeln!(text, "{} {} {} {} {} {} {} {}", pose.time, t.x, t.y, t.z, q[0], q[1], q[2], q[3]);
    }
    text
}

/// Processor time of this thread, s: other programs on the machine do not count. Zero where the system does not tell.
fn processor_secs() -> f64 {
    let told = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    told.split_whitespace().next().and_then(|n| n.parse::<f64>().ok()).unwrap_or(0.0) * 1e-9
}

/// Peak resident memory of this process; NaN where the system does not tell.
fn peak_megabytes() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    let kilobytes = line.and_then(|l| l.trim().trim_end_matches("kB").trim().parse::<f64>().ok());
    kilobytes.map_or(f64::NAN, |kb| kb / 1024.0)
}
