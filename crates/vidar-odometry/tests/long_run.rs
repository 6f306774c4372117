//! A flight of any length in bounded memory: one round through a room, flown again and again.
//!
//! The short form is part of the suite. An hour (450 rounds of 8 s):
//! `cargo test --release -p vidar-odometry --test long_run -- --ignored --nocapture`

// A test may stop at the first surprise; the lint knows that of test functions only, not of their helpers.
#![allow(clippy::unwrap_used, clippy::print_stderr)]

use nalgebra::Vector3;
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicIsize, Ordering};
use vidar_core::{
    BodyFrame, CameraId, Duration, Frame, FrameId, FrameImage, Image, ImuSample, LieGroup, Se3, SensorEvent,
    So3, StampedPose, Timestamp, Trajectory,
};
use vidar_odometry::{Odometry, OdometryConfig, Status};
use vidar_synth::{FlightPath, Start, SynthConfig, SynthView, World, render_views, simulate_imu};

/// Counts the bytes that are held.
struct Weighing;

static HELD: AtomicIsize = AtomicIsize::new(0);

// SAFETY: every call goes on to the system's allocator unchanged.
unsafe impl GlobalAlloc for Weighing {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        HELD.fetch_add(layout.size() as isize, Ordering::Relaxed);
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        HELD.fetch_sub(layout.size() as isize, Ordering::Relaxed);
        unsafe { System.dealloc(pointer, layout) }
    }
    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        HELD.fetch_add(size as isize - layout.size() as isize, Ordering::Relaxed);
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Weighing = Weighing;

/// Length of a round, s, and of an image, ms.
const ROUND_SECS: i64 = 8;
const IMAGE_MS: i64 = 50;

/// One round: what the camera and the IMU tell, with times from its beginning, and the true poses at the images.
struct Round {
    rig: vidar_core::Rig,
    images: Vec<Image<u8>>,
    imu_samples: Vec<ImuSample>,
    truth: Vec<Se3>,
}

/// Where the body is; everything repeats after a round.
fn place(secs: f64) -> Se3 {
    let phase = std::f64::consts::TAU * secs / ROUND_SECS as f64;
    let position = Vector3::new(1.6 * phase.cos(), 1.4 * phase.sin(), 1.5 + 0.3 * (2.0 * phase).sin());
    let about = |axis: Vector3<f64>, angle: f64| So3::exp(&(axis * angle));
    // Looking across the middle, EuRoC's body: x up, y right, z ahead.
    let ahead = about(Vector3::z(), phase + std::f64::consts::PI + 0.3 * (2.0 * phase).sin())
        * about(Vector3::y(), 0.15 * (3.0 * phase).sin())
        * about(Vector3::x(), 0.2 * (2.0 * phase).cos());
    let mounted = nalgebra::Matrix3::new(0.0, 0.0, 1.0, 0.0, -1.0, 0.0, 1.0, 0.0, 0.0);
    Se3::new(ahead * So3::from_matrix(&mounted).unwrap(), position)
}

fn round() -> Round {
    let epoch = Timestamp::from_nanos(0);
    // The second of three rounds: the spline through it knows nothing of beginnings and ends.
    let poses = (0..300 * ROUND_SECS).map(|k| StampedPose {
        time: epoch + Duration::from_millis(10 * k),
        world_from_body: place(0.01 * k as f64),
    });
    let trajectory = Trajectory::new(BodyFrame::Imu, poses.collect()).unwrap();
    let config = SynthConfig {
        start: Start::InFlight,
        duration_secs: 3.0 * ROUND_SECS as f64,
        initial_gyro_bias_rad_per_s: 0.02,
        initial_accel_bias_m_per_s2: 0.05,
        ..SynthConfig::default()
    };
    let flight = FlightPath::from_trajectory(&trajectory, &config).unwrap();
    let world = World::build(&config, &flight).unwrap();
    let (camera, begin) =
        (vidar_synth::euroc_camera(config.width, config.height).unwrap(), ROUND_SECS as f64);
    let count = ROUND_SECS * 1000 / IMAGE_MS;
    let truth: Vec<Se3> =
        (0..count).map(|k| flight.world_from_body(begin + 1e-3 * (k * IMAGE_MS) as f64)).collect();
    let views: Vec<SynthView> = truth
        .iter()
        .map(|pose| SynthView {
            world_from_camera: *pose * vidar_synth::euroc_body_from_camera(),
            camera: camera.clone(),
        })
        .collect();
    let images = render_views(&world, &views, 1).unwrap().iter().map(|v| v.image.to_gray8()).collect();
    let all = simulate_imu(&flight, &config).samples;
    let (from, length) = (all[0].time + Duration::from_millis(1000 * ROUND_SECS), 1000 * ROUND_SECS);
    let within = all.iter().filter(|s| s.time >= from && s.time < from + Duration::from_millis(length));
    let imu_samples = within.map(|s| ImuSample { time: epoch + (s.time - from), ..*s }).collect();
    Round { rig: vidar_synth::euroc_rig(config.width, config.height).unwrap(), images, imu_samples, truth }
}

/// What the odometry holds after every round, bytes; its worst misjudgement of a round's way, as a share of it; losses.
struct Flown {
    held: Vec<isize>,
    worst_scale: f64,
    losses: usize,
    missing: usize,
}

fn fly(round: &Round, rounds: i64) -> Flown {
    let before = HELD.load(Ordering::Relaxed);
    let mut flown =
        Flown { held: Vec::with_capacity(rounds as usize), worst_scale: 0.0, losses: 0, missing: 0 };
    let mut odometry = Odometry::new(&round.rig, CameraId(0), &OdometryConfig::default()).unwrap();
    let way = |places: &[Vector3<f64>]| places.windows(10).map(|w| (w[9] - w[0]).norm()).sum::<f64>();
    let truth: Vec<Vector3<f64>> = round.truth.iter().map(|p| p.translation).collect();
    let mut places: Vec<Vector3<f64>> = Vec::with_capacity(truth.len());
    for lap in 0..rounds {
        let begin = Timestamp::from_nanos(1_000_000_000) + Duration::from_millis(1000 * ROUND_SECS * lap);
        let mut imu_samples = round.imu_samples.iter().peekable();
        places.clear();
        for (k, image) in round.images.iter().enumerate() {
            let at = Duration::from_millis(IMAGE_MS * k as i64);
            while let Some(s) = imu_samples
                .next_if(|s| s.time - Timestamp::from_nanos(0) < at + Duration::from_millis(IMAGE_MS))
            {
                let time = begin + (s.time - Timestamp::from_nanos(0));
                let _ = odometry
                    .push(SensorEvent::Imu(ImuSample { time, ..*s }))
                    .unwrap()
                    .map(|o| note(&mut flown, &mut places, &o));
            }
            let frame = Frame {
                id: FrameId((lap as usize * round.images.len() + k) as u32),
                time: begin + at,
                camera: CameraId(0),
                image: FrameImage::Gray8(image.clone()),
            };
            let _ =
                odometry.push(SensorEvent::Image(frame)).unwrap().map(|o| note(&mut flown, &mut places, &o));
        }
        if lap > 0 && places.len() == truth.len() {
            flown.worst_scale = flown.worst_scale.max((way(&places) / way(&truth)).ln().abs());
        } else if lap > 0 {
            flown.missing += truth.len() - places.len();
        }
        flown.held.push(HELD.load(Ordering::Relaxed) - before);
        if rounds > 10 && lap % 50 == 49 {
            eprintln!(
                "{} rounds: {} bytes, scale {:.4}, {} losses",
                lap + 1,
                flown.held[lap as usize],
                flown.worst_scale,
                flown.losses
            );
        }
    }
    flown
}

fn note(flown: &mut Flown, places: &mut Vec<Vector3<f64>>, output: &vidar_odometry::OdometryOutput) {
    match &output.status {
        Status::Tracking(t) => places.push(t.state.world_from_body.translation),
        Status::Lost(_) => flown.losses += 1,
        Status::Waiting(_) => {}
    }
}

/// From round to round the window holds now a few more landmarks, now a few less: nothing but that may change.
const SWING_BYTES: isize = 4 << 20;

fn evaluate(flown: &Flown) {
    assert_eq!((flown.losses, flown.missing), (0, 0), "losses and images without a state");
    assert!(flown.worst_scale < 0.02, "a round was {} off in length", flown.worst_scale);
    let (first, last) = (flown.held[1], flown.held[flown.held.len() - 1]);
    assert!(last < first + SWING_BYTES, "{first} bytes after two rounds, {last} after all");
    let most = flown.held.iter().max().unwrap();
    assert!(*most < 100 << 20, "{most} bytes");
}

#[test]
fn rounds_leave_no_memory_behind() {
    evaluate(&fly(&round(), 3));
}

#[test]
#[ignore = "an hour of flight: cargo test --release -p vidar-odometry --test long_run -- --ignored --nocapture"]
fn an_hour_is_flown_in_bounded_memory() {
    let flown = fly(&round(), 3600 / ROUND_SECS);
    let (first, last) = (flown.held[1], flown.held[flown.held.len() - 1]);
    eprintln!(
        "held after two rounds {first}, after an hour {last} bytes; worst round {:.4}",
        flown.worst_scale
    );
    evaluate(&flown);
}
