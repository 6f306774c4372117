//! Runs the odometry over recorded or rendered sequences and prints a row of figures per sequence.
//!
//! ```text
//! cargo run --release -p vidar-odometry --example evaluate -- [--mono] [--start S] [--secs S] [--verbose]
//!     [--repeat N] [--stages] [--paced] [--image-noise GRAY] [--imu-noise FACTOR] [--halve]
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
//! `--paced` feeds each image no earlier than it was filmed, as a camera does, and says what an image costs the thread that feeds it,
//! in processor time; attempts to start run on another thread, which then has the time that it has live.
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

mod corrupt;
mod print;

use corrupt::{Corruptor, halved_camera};
use nalgebra::Vector3;
use print::{costs, frames, row, stages, tell, tum};
use std::path::{Path, PathBuf};
use vidar_core::{Duration, Health, LieGroup, NavState, Se3, SensorEvent, So3, StampedPose, Timestamp};
use vidar_dataset::{OpenOptions, Recording};
use vidar_odometry::bundle_adjustment::{Adjusted, CalibrationSigmas};
use vidar_odometry::{ImuUse, Odometry, OdometryConfig, OdometryOutput, StageTimes};

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
    paced: bool,
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
            "--paced" => found.paced = true,
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
#[derive(Default)]
struct Run {
    outputs: Vec<OdometryOutput>,
    times: Vec<StageTimes>,
    /// Processor time of the feeding thread per image, s, and whether the image has a state.
    processor: Vec<(f64, bool)>,
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
    if options.paced {
        println!("{}", costs(&run.processor));
    }
    Ok(())
}

/// Waits until as much time has passed since the first image as its camera needed.
struct Pace(Option<(std::time::Instant, Timestamp)>);

impl Pace {
    fn wait_for(&mut self, time: Timestamp) {
        let (begun, first) = *self.0.get_or_insert_with(|| (std::time::Instant::now(), time));
        let due = std::time::Duration::from_secs_f64((time - first).as_secs_f64().max(0.0));
        std::thread::sleep(due.saturating_sub(begun.elapsed()));
    }
}

fn run(dataset: &Recording, options: &Options) -> Result<Run, Failure> {
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
    let mut run = Run::default();
    let (mut pace, mut timing) = (Pace(None), None);
    if options.adjust {
        odometry.keep_log();
    }
    for event in dataset.events() {
        let mut event = event?;
        if matches!(event, SensorEvent::GroundTruth { .. } | SensorEvent::Depth { .. }) {
            continue;
        }
        corruptor.corrupt(&mut event);
        if let (true, SensorEvent::Image(frame)) = (options.paced, &event) {
            pace.wait_for(frame.time);
        }
        let begun = thread_secs();
        if let Some(output) = odometry.push(event)? {
            run.processor.push((thread_secs() - begun, output.tracking().is_some()));
            run.times.push(odometry.stage_times());
            if options.verbose
                && timing.replace(odometry.timing().sigmas_secs) != Some(odometry.timing().sigmas_secs)
            {
                eprintln!("  {} frame {}: {:?}", output.time, output.frame_id, odometry.timing());
            }
            keep(&mut run, output, options.mono);
        }
    }
    for output in odometry.finish() {
        keep(&mut run, output, options.mono);
    }
    if options.adjust {
        for variant in std::iter::once("").chain(options.variants.iter().map(String::as_str)) {
            let sigmas = sigmas(variant, &mut odometry)?;
            let begun = thread_secs();
            let adjusted = odometry.adjust(&sigmas)?;
            let secs = thread_secs() - begun;
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

/// Processor time of this thread so far, s; wall time where the system does not tell.
fn thread_secs() -> f64 {
    #[cfg(unix)]
    {
        let told = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
        told.tv_sec as f64 + 1e-9 * told.tv_nsec as f64
    }
    #[cfg(not(unix))]
    {
        std::time::SystemTime::UNIX_EPOCH.elapsed().map_or(f64::NAN, |t| t.as_secs_f64())
    }
}
