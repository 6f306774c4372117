//! Writes a sequence in EuRoC layout, whole or not at all.

use crate::config::SynthConfig;
use crate::error::SynthError;
use crate::flight::FlightPath;
use crate::imu::simulate_imu;
use crate::layout;
use crate::photometry::Photometry;
use crate::png_file;
use crate::render::{RayTable, expose};
use crate::rig;
use crate::scan::{Scan, Witness, scan_observed_surface};
use crate::simulation::{CONFIG_FILE, FLIGHT_FILE, flight_list};
use crate::world::World;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use vidar_core::{BodyFrame, CameraModel, Se3, Timestamp, Trajectory};

/// What was written.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SynthSummary {
    /// Images of cam0 (and of depth0, if asked for).
    pub frames: usize,
    /// Readings of imu0, and poses of the ground truth.
    pub imu_samples: usize,
    /// Points of the reference cloud.
    pub scan_points: usize,
    /// Length of the flight, s.
    pub duration_secs: f64,
    /// Length of the path, m.
    pub path_length_m: f64,
    /// Shapes in the world, the room's shell included.
    pub shapes: usize,
}

/// Told how many frames of how many are done; `false` stops the work. Called from several threads.
pub type Progress<'a> = dyn Fn(usize, usize) -> bool + Sync + 'a;

/// Writes the sequence that `config` describes to `out/mav0`, the configuration to `out/synth.toml` and a given flight
/// to `out/flight.csv`; [`crate::Simulation::open`] brings all of it back.
///
/// `flight` takes the place of the built-in flight; the world is built around it. Everything is first written to a
/// hidden folder inside `out` and then renamed, so that after an error or a cancellation nothing is left.
///
/// # Errors
/// A bad configuration or trajectory, an `out` that already holds a sequence or cannot be written, cancellation.
pub fn write_sequence(
    out: &Path,
    config: &SynthConfig,
    flight: Option<&Trajectory>,
    progress: &Progress<'_>,
) -> Result<SynthSummary, SynthError> {
    config.validate()?;
    let path = FlightPath::new(config, flight)?;
    let staging = Staging::new(out)?;
    if !progress(0, frame_count(config, &path)) {
        return Err(SynthError::Cancelled);
    }
    let world = World::build(config, &path)?;
    let writer = Writer {
        config,
        path: &path,
        world: &world,
        camera: rig::euroc_camera(config.width, config.height)?,
        mav: staging.folder.join("mav0"),
    };
    let times = writer.times();
    let witnesses = writer.write_frames(progress)?;
    writer.write_camera_texts(&times)?;
    let imu_samples = writer.write_inertial()?;
    let scan_points = writer.write_scan(&witnesses)?;
    writer.write_config(&staging.folder, flight)?;
    if !progress(times.len(), times.len()) {
        return Err(SynthError::Cancelled);
    }
    staging.publish()?;
    Ok(SynthSummary {
        frames: times.len(),
        imu_samples,
        scan_points,
        duration_secs: path.duration_secs(),
        path_length_m: path.path_length_m(),
        shapes: world.shape_count(),
    })
}

fn frame_count(config: &SynthConfig, path: &FlightPath) -> usize {
    ((path.duration_secs() * config.camera_rate_hz - 1e-6).ceil().max(1.0)) as usize
}

struct Writer<'a> {
    config: &'a SynthConfig,
    path: &'a FlightPath,
    world: &'a World,
    camera: CameraModel,
    mav: PathBuf,
}

impl Writer<'_> {
    fn times(&self) -> Vec<Timestamp> {
        let n = frame_count(self.config, self.path);
        (0..n).map(|k| layout::stamp(k, self.config.camera_rate_hz).0).collect()
    }

    /// Renders and writes all images and depths; returns what each frame saw.
    fn write_frames(&self, progress: &Progress<'_>) -> Result<Vec<Witness>, SynthError> {
        make_folder(&self.mav.join("cam0/data"))?;
        if self.config.depth {
            make_folder(&self.mav.join("depth0/data"))?;
        }
        let rays = RayTable::new(&self.camera, self.config.blur_samples);
        let photometry = Photometry::new(self.config);
        let total = frame_count(self.config, self.path);
        let done = AtomicUsize::new(0);
        let cancelled = AtomicBool::new(false);
        let frame = |k: usize| {
            if cancelled.load(Ordering::Relaxed) {
                return Err(SynthError::Cancelled);
            }
            let witness = self.write_frame(k, &rays, &photometry)?;
            if !progress(done.fetch_add(1, Ordering::Relaxed) + 1, total) {
                cancelled.store(true, Ordering::Relaxed);
                return Err(SynthError::Cancelled);
            }
            Ok(witness)
        };
        (0..total).into_par_iter().with_max_len(1).map(frame).collect()
    }

    fn write_frame(&self, k: usize, rays: &RayTable, photometry: &Photometry) -> Result<Witness, SynthError> {
        let config = self.config;
        let (time, secs) = layout::stamp(k, config.camera_rate_hz);
        let poses = self.poses_within_exposure(secs, rays.centre());
        let exposed = expose(self.world, rays, &poses);
        let name = format!("{}.png", time.nanos());
        let (width, height) = (config.width, config.height);
        let image = photometry.develop(&exposed.radiance, k, secs);
        png_file::write_gray8(&self.mav.join("cam0/data").join(&name), width, height, &image)?;
        if config.depth {
            let units = f64::from(self.depth_units_per_metre());
            let encode = |&z: &f32| {
                let value = (f64::from(z) * units).round();
                // NaN and what lies beyond the range are 0: no depth.
                if value >= 1.0 && value <= f64::from(u16::MAX) { value as u16 } else { 0 }
            };
            let depth: Vec<u16> = exposed.depth.iter().map(encode).collect();
            png_file::write_gray16(&self.mav.join("depth0/data").join(&name), width, height, &depth)?;
        }
        Ok(Witness::new(&poses[rays.centre()], &exposed.depth, width))
    }

    /// Poses of the camera over the exposure around `secs`; the one of sample `centre` is exactly at `secs`.
    fn poses_within_exposure(&self, secs: f64, centre: usize) -> Vec<Se3> {
        let n = self.config.blur_samples;
        let body_from_camera = rig::euroc_body_from_camera();
        let at = |s: usize| {
            let offset = self.config.exposure_secs * (s as f64 - centre as f64) / n as f64;
            self.path.world_from_body(secs + offset) * body_from_camera
        };
        (0..n).map(at).collect()
    }

    /// The finest unit in which the longest sight line of the room fits 16 bits.
    fn depth_units_per_metre(&self) -> u32 {
        let room = self.world.extent();
        let longest = (room.max - room.min).norm();
        [5000, 2000, 1000, 500, 200].into_iter().find(|&u| longest * f64::from(u) < 65_535.0).unwrap_or(100)
    }

    fn write_camera_texts(&self, times: &[Timestamp]) -> Result<(), SynthError> {
        let rate = self.config.camera_rate_hz;
        let distortion = match &self.camera {
            CameraModel::RadTan(m) => m.distortion,
            _ => [0.0; 4],
        };
        let list = layout::image_list(times);
        let yaml = |units| layout::camera_yaml(&self.camera, distortion, rate, units);
        layout::write_text(&self.mav.join("cam0/data.csv"), &list)?;
        layout::write_text(&self.mav.join("cam0/sensor.yaml"), &yaml(None))?;
        if self.config.depth {
            layout::write_text(&self.mav.join("depth0/data.csv"), &list)?;
            let units = Some(self.depth_units_per_metre());
            layout::write_text(&self.mav.join("depth0/sensor.yaml"), &yaml(units))?;
        }
        Ok(())
    }

    fn write_inertial(&self) -> Result<usize, SynthError> {
        let record = simulate_imu(self.path, self.config);
        let imu = self.mav.join("imu0");
        make_folder(&imu)?;
        layout::write_text(&imu.join("data.csv"), &layout::imu_list(&record))?;
        layout::write_text(&imu.join("sensor.yaml"), &layout::imu_yaml(self.config))?;
        let truth = self.mav.join("state_groundtruth_estimate0");
        make_folder(&truth)?;
        let list = layout::truth_list(self.path, &record, self.config.imu_rate_hz);
        layout::write_text(&truth.join("data.csv"), &list)?;
        let yaml = layout::plain_yaml("visual-inertial", "exact state of the simulated body");
        layout::write_text(&truth.join("sensor.yaml"), &yaml)?;
        Ok(record.samples.len())
    }

    fn write_scan(&self, witnesses: &[Witness]) -> Result<usize, SynthError> {
        let config = self.config;
        let scan = Scan { seed: config.seed, spacing_m: config.scan_spacing_m, noise_m: config.scan_noise_m };
        let points = scan_observed_surface(self.world, &self.camera, witnesses, &scan)?;
        let folder = self.mav.join("pointcloud0");
        make_folder(&folder)?;
        layout::write_ply(&folder.join("data.ply"), &points)?;
        let yaml =
            layout::plain_yaml("pointcloud", "surface that cam0 saw, in the world frame of the ground truth");
        layout::write_text(&folder.join("sensor.yaml"), &yaml)?;
        Ok(points.len())
    }

    fn write_config(&self, folder: &Path, flown: Option<&Trajectory>) -> Result<(), SynthError> {
        layout::write_text(
            &self.mav.join("body.yaml"),
            "%YAML:1.0\ncomment: simulated micro aerial vehicle\n",
        )?;
        if let Some(flown) = flown {
            // Told of the body, so that the sequence can be simulated again without knowing whose it was.
            let flown =
                flown.in_frame(BodyFrame::Imu, &rig::euroc_rig(self.config.width, self.config.height)?)?;
            layout::write_text(&folder.join(FLIGHT_FILE), &flight_list(&flown))?;
        }
        let flight = if flown.is_some() { "flown along flight.csv" } else { "built-in flight" };
        let text = format!(
            "# vidar-synth {}, {flight}\n{}",
            env!("CARGO_PKG_VERSION"),
            toml::to_string(self.config)?
        );
        layout::write_text(&folder.join(CONFIG_FILE), &text)
    }
}

fn make_folder(path: &Path) -> Result<(), SynthError> {
    std::fs::create_dir_all(path).map_err(SynthError::write(path))
}

/// A hidden folder inside the output; removed when dropped.
struct Staging {
    out: PathBuf,
    folder: PathBuf,
    /// The topmost folder that had to be made for `out`.
    made: Option<PathBuf>,
}

impl Staging {
    fn new(out: &Path) -> Result<Self, SynthError> {
        let goal = out.join("mav0");
        if goal.symlink_metadata().is_ok() {
            return Err(SynthError::OutputExists { path: goal });
        }
        let made = out.ancestors().take_while(|a| !a.as_os_str().is_empty() && !a.exists()).last();
        let folder = out.join(format!(".synth-partial-{}", std::process::id()));
        let staging = Self { out: out.to_path_buf(), made: made.map(Path::to_path_buf), folder };
        make_folder(&staging.folder)?;
        Ok(staging)
    }

    /// Moves what was written to its place; `mav0` last, so that where it stands everything stands.
    fn publish(mut self) -> Result<(), SynthError> {
        for name in [FLIGHT_FILE, CONFIG_FILE, "mav0"] {
            let (made, goal) = (self.folder.join(name), self.out.join(name));
            if name != FLIGHT_FILE || made.exists() {
                std::fs::rename(made, &goal).map_err(SynthError::write(&goal))?;
            }
        }
        self.made = None;
        Ok(())
    }
}

impl Drop for Staging {
    fn drop(&mut self) {
        // Best effort: what cannot be removed cannot be reported from here either.
        let _ = std::fs::remove_dir_all(&self.folder);
        // Only folders that are empty again go, so that nobody else's file can.
        if let Some(made) = &self.made {
            for folder in self.out.ancestors().take_while(|a| a.starts_with(made)) {
                let _ = std::fs::remove_dir(folder);
            }
        }
    }
}
