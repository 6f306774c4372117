//! Runs the odometry over recorded or rendered sequences and prints a row of figures per sequence.
//!
//! ```text
//! cargo run --release -p vidar-odometry --example evaluate -- [--mono] [--start S] [--secs S] [--verbose]
//!     [--repeat N] [--stages] [--image-noise GRAY] [--imu-noise FACTOR] [--halve]
//!     [--live] [--adjust] [--variant KEY=VALUE,...]... [--lever-error M] [--turn-error DEG] [--trajectory FILE] [--frames FILE] [--set KEY=VALUE]... SEQUENCE...
//! ```
//!
//! A sequence is any folder with images, IMU measurements and ground truth that `vidar-dataset` reads. Figures: ATE after the best
//! rigid motion and after the best similarity, |ln s|, relative error per metre, share of frames with a pose, seconds
//! from the first image to the first metric pose, time per image (decoding left out), peak memory. `--set` changes
//! a number of the odometry's configuration; `--frames` writes what became of the tracks in every image.
//!
//! Time is wall time. On a machine that others use too, `--repeat 5` runs a sequence five times (the results are the same
//! bits) and takes the least of every image's five times. `--stages` splits the median and the 95 % quantile by stage.
//!
//! The camera's clock offset, readout and rotation are found in a first pass over the beginning; `--live` leaves it out,
//! as for a stream, which cannot be read twice.
//!
//! `--adjust` evaluates the trajectory of the bundle adjustment after the recording's end in a second row, with σ(ln s) and the
//! processor seconds it took. `--variant KEY=VALUE,KEY=VALUE` adjusts once more with other limits of what may change (`CalibrationSigmas`;
//! `loops=0` leaves loops out, for all that follow); `--lever-error M` and `--turn-error DEG` make the camera's place on the body wrong before the odometry sees it.
//!
//! `--image-noise`, `--imu-noise` corrupt what is read: noise of so many grey levels; so much more inertial noise that
//! its whole is FACTOR times the data sheet's (the bias stays). `--halve` averages 2 × 2 pixels.

#![allow(clippy::print_stdout, clippy::print_stderr)] // a program

use nalgebra::Vector3;
use std::path::{Path, PathBuf};
use vidar_core::camera::RadTan;
use vidar_core::{
    BodyFrame, CameraModel, Duration, FrameImage, Health, Image, ImuNoise, LieGroup, NavState, Se3,
    SensorEvent, So3, StampedPose, Timestamp, Trajectory,
};
use vidar_dataset::{Dataset, OpenOptions};
use vidar_eval::{TrajectoryEvalConfig, evaluate_trajectory};
use vidar_odometry::bundle_adjustment::{Adjusted, CalibrationSigmas};
use vidar_odometry::simulate::Random;
use vidar_odometry::{ImuUse, Odometry, OdometryConfig, OdometryOutput, Stage, StageTimes, Status};

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
    repeat: usize,
    stages: bool,
    image_noise: f64,
    imu_noise: f64,
    halve: bool,
    live: bool,
    adjust: bool,
    /// What the adjustments after the first change.
    variants: Vec<String>,
    lever_error_m: f64,
    turn_error_deg: f64,
}

fn options() -> Result<Options, Failure> {
    let mut found = Options { repeat: 1, imu_noise: 1.0, ..Options::default() };
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        let mut value = || args.next().ok_or(format!("{arg} needs a value"));
        match arg.as_str() {
            "--mono" => found.mono = true,
            "--repeat" => found.repeat = value()?.parse::<usize>()?.max(1),
            "--stages" => found.stages = true,
            "--image-noise" => found.image_noise = value()?.parse()?,
            "--imu-noise" => found.imu_noise = value()?.parse()?,
            "--halve" => found.halve = true,
            "--live" => found.live = true,
            "--adjust" => found.adjust = true,
            "--verbose" => found.verbose = true,
            "--start" => found.start_secs = value()?.parse()?,
            "--secs" => found.secs = Some(value()?.parse()?),
            "--set" => {
                let text = value()?;
                let (key, number) = text.split_once('=').ok_or("--set needs KEY=VALUE")?;
                found.settings.push((key.to_owned(), number.parse()?));
            }
            "--variant" => found.variants.push(value()?),
            "--lever-error" => found.lever_error_m = value()?.parse()?,
            "--turn-error" => found.turn_error_deg = value()?.parse()?,
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
    times: Vec<StageTimes>,
    poses: Vec<StampedPose>,
    /// The adjustments: what was changed, and the seconds each took.
    adjusted: Vec<(String, Adjusted, f64)>,
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
    let mut run = run(&dataset, options)?;
    for _ in 1..options.repeat {
        let again = crate::run(&dataset, options)?;
        // Millions of instructions in between may differ; an image's least time is its own.
        run.times.iter_mut().zip(&again.times).for_each(|(least, now)| {
            if now.total() < least.total() {
                *least = *now;
            }
        });
    }
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
    let truth = dataset.ground_truth.as_ref().ok_or("no ground truth")?;
    let images: (Timestamp, usize) = (first_image, dataset.images.len());
    let live = row(&name, run.poses, images, &run.times, truth)?;
    if let Some(file) = &options.trajectory {
        std::fs::write(file, tum(&live))?;
    }
    for (variant, adjusted, secs) in &run.adjusted {
        let offset = Duration::from_secs_f64(adjusted.calibration.time_offset_secs);
        let pose = |state: &NavState| StampedPose {
            time: state.time + offset,
            world_from_body: state.world_from_body,
        };
        row(
            &format!("  adjusted {variant}"),
            adjusted.images.iter().map(|(_, state)| pose(state)).collect(),
            images,
            &[],
            truth,
        )?;
        let place = dataset.rig.camera(dataset.camera).map(|c| c.body_from_camera).unwrap_or(Se3::IDENTITY);
        let found = &adjusted.calibration.body_from_camera;
        println!(
            "  = σ(ln s) {:.4}, {:.1} s, chi2 {:.3}, place off by {:.4} m {:.3} deg, σ {:.4} m, noise {:.1e} {:.1e}, clock {:.2} ms, loops {} {}, {:?}",
            adjusted.scale_std,
            secs,
            adjusted.report.inertial_chi2_per_dof,
            (found.translation - place.translation).norm(),
            (place.rotation.inverse() * found.rotation).angle_rad().to_degrees(),
            adjusted.calibration.sigmas[5..8].iter().map(|s| s * s).sum::<f64>().sqrt(),
            adjusted.imu.gyro_noise_density,
            adjusted.imu.accel_noise_density,
            1e3 * adjusted.calibration.time_offset_secs,
            adjusted.report.loops,
            adjusted.report.loop_matches,
            adjusted.findings,
        );
    }
    if options.stages {
        println!("{}", stages(&run.times));
    }
    Ok(())
}

/// Prints the figures of one trajectory.
fn row(
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
fn stages(times: &[StageTimes]) -> String {
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

/// What corrupts a recording while it is read.
struct Corruptor {
    random: Random,
    image_noise: f64,
    /// Standard deviations per reading: rad/s, m/s².
    imu_noise: [f64; 2],
    halve: bool,
}

impl Corruptor {
    fn new(options: &Options, noise: Option<ImuNoise>) -> Self {
        // Variances add up: what is missing to FACTOR times the data sheet's.
        let more = (options.imu_noise * options.imu_noise - 1.0).max(0.0).sqrt();
        let per_reading = |density: f64, n: &ImuNoise| more * density * n.rate_hz.sqrt();
        let imu_noise = noise.map_or([0.0; 2], |n| {
            [per_reading(n.gyro_noise_density, &n), per_reading(n.accel_noise_density, &n)]
        });
        Self { random: Random::new(7), image_noise: options.image_noise, imu_noise, halve: options.halve }
    }

    fn corrupt(&mut self, event: &mut SensorEvent) {
        match event {
            SensorEvent::Imu(sample) => {
                let [gyro, accel] = self.imu_noise;
                for k in 0..3 {
                    sample.gyro.0[k] += gyro * self.random.normal();
                    sample.accel.0[k] += accel * self.random.normal();
                }
            }
            SensorEvent::Image(frame) if self.halve || self.image_noise > 0.0 => {
                let mut gray = frame.image.to_gray8();
                if self.halve {
                    gray = halved(&gray);
                }
                let (random, sigma) = (&mut self.random, self.image_noise);
                if sigma > 0.0 {
                    gray = gray
                        .map(|&p| (f64::from(p) + sigma * random.normal()).round().clamp(0.0, 255.0) as u8);
                }
                frame.image = FrameImage::Gray8(gray);
            }
            _ => {}
        }
    }
}

fn halved(image: &Image<u8>) -> Image<u8> {
    let at = |x: usize, y: usize| u32::from(image[(x, y)]);
    Image::from_fn(image.width() / 2, image.height() / 2, |x, y| {
        let (x, y) = (2 * x, 2 * y);
        ((at(x, y) + at(x + 1, y) + at(x, y + 1) + at(x + 1, y + 1) + 2) / 4) as u8
    })
}

/// The camera of halved images; of distorted ones only radtan's, which EuRoC has.
fn halved_camera(model: &CameraModel) -> Result<CameraModel, Failure> {
    let k = model.intrinsics();
    let half = k.resized(k.width / 2, k.height / 2)?;
    match model {
        CameraModel::Pinhole(_) => Ok(CameraModel::Pinhole(half)),
        CameraModel::RadTan(m) => Ok(CameraModel::RadTan(RadTan::with_k3(half, m.distortion, m.k3)?)),
        other => Err(format!("--halve does not know {}", other.name()).into()),
    }
}

fn run(dataset: &Dataset, options: &Options) -> Result<Run, Failure> {
    let imu = if options.mono { ImuUse::Off } else { ImuUse::Auto };
    let mut config = OdometryConfig { imu, ..OdometryConfig::default() };
    for (key, number) in &options.settings {
        set(&mut config, key, *number)?;
    }
    let mut rig = dataset.rig.clone();
    if options.halve {
        for camera in &mut rig.cameras {
            camera.model = halved_camera(&camera.model)?;
        }
    }
    for camera in &mut rig.cameras {
        let diagonal = Vector3::repeat(1.0).normalize();
        let turn = So3::exp(&(diagonal * options.turn_error_deg.to_radians()));
        let place = &camera.body_from_camera;
        camera.body_from_camera =
            Se3::new(place.rotation * turn, place.translation + diagonal * options.lever_error_m);
    }
    let mut corruptor = Corruptor::new(options, rig.imu);
    let mut odometry = match options.live || options.mono {
        true => Odometry::new(&rig, dataset.camera, &config)?,
        false => {
            let events = dataset.events().filter_map(Result::ok);
            let timing = Odometry::find_timing(&rig, dataset.camera, &config, events)?;
            if options.verbose {
                println!("  {timing:?}");
            }
            Odometry::with_timing(&rig, dataset.camera, &config, &timing)?
        }
    };
    let mut run = Run { outputs: Vec::new(), times: Vec::new(), poses: Vec::new(), adjusted: Vec::new() };
    if options.adjust {
        odometry.keep_log();
    }
    for event in dataset.events() {
        let mut event = event?;
        if matches!(event, SensorEvent::GroundTruth { .. } | SensorEvent::Depth { .. }) {
            continue;
        }
        corruptor.corrupt(&mut event);
        if let Some(output) = odometry.push(event)? {
            run.times.push(odometry.stage_times());
            keep(&mut run, output, options.mono);
        }
    }
    for output in odometry.finish() {
        keep(&mut run, output, options.mono);
    }
    if options.adjust {
        for variant in std::iter::once("").chain(options.variants.iter().map(String::as_str)) {
            let sigmas = sigmas(variant, &mut odometry)?;
            let begun = processor_secs();
            let adjusted = odometry.adjust(&sigmas)?;
            let secs = processor_secs() - begun;
            if options.verbose {
                println!("  {:?}\n  {:?}\n  {:?}", adjusted.report, adjusted.calibration, adjusted.imu);
            }
            run.adjusted.push((variant.to_owned(), adjusted, secs));
        }
    }
    // Ground truth is in the IMU's clock.
    let offset = Duration::from_secs_f64(odometry.timing().time_offset_secs);
    run.poses.iter_mut().for_each(|p| p.time = p.time + offset);
    Ok(run)
}

/// What the adjustment may change.
fn sigmas(variant: &str, odometry: &mut Odometry) -> Result<CalibrationSigmas, Failure> {
    let mut sigmas = CalibrationSigmas::default();
    for one in variant.split(',').filter(|one| !one.is_empty()) {
        let (key, number) = one.split_once('=').ok_or("--variant needs KEY=VALUE")?;
        let value = match key {
            "loops" => {
                odometry.forget_log_images();
                continue;
            }
            "time_offset_secs" => &mut sigmas.time_offset_secs,
            "readout_secs" => &mut sigmas.readout_secs,
            "rotation_rad" => &mut sigmas.rotation_rad,
            "position_m" => &mut sigmas.position_m,
            "focal" => &mut sigmas.focal,
            "principal_point_px" => &mut sigmas.principal_point_px,
            "distortion" => &mut sigmas.distortion,
            "gyro_gain" => &mut sigmas.gyro_gain,
            "accel_gain" => &mut sigmas.accel_gain,
            other => return Err(format!("unknown key {other} of a variant").into()),
        };
        *value = number.parse()?;
    }
    Ok(sigmas)
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
        "gyro_gain_std" => config.gyro_gain_std = number,
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

fn tum(trajectory: &Trajectory) -> String {
    use std::fmt::Write as _;
    let mut text = String::new();
    for pose in trajectory.poses() {
        let (t, q) = (pose.world_from_body.translation, pose.world_from_body.rotation.quaternion_xyzw());
        let _ = writeln!(text, "{} {} {} {} {} {} {} {}", pose.time, t.x, t.y, t.z, q[0], q[1], q[2], q[3]);
    }
    text
}

/// Processor time of this process' first thread so far, s; NaN where the system does not tell.
fn processor_secs() -> f64 {
    let told = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    let nanos = told.split_whitespace().next().and_then(|n| n.parse::<f64>().ok());
    nanos.map_or(f64::NAN, |n| 1e-9 * n)
}

/// Peak resident memory of this process; NaN where the system does not tell.
fn peak_megabytes() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    let kilobytes = line.and_then(|l| l.trim().trim_end_matches("kB").trim().parse::<f64>().ok());
    kilobytes.map_or(f64::NAN, |kb| kb / 1024.0)
}
