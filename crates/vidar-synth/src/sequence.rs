//! Writes a sequence in EuRoC layout, whole or not at all.

use crate::config::SynthConfig;
use crate::device::CalibrationKind;
use crate::error::SynthError;
use crate::flight::FlightPath;
use crate::image_file;
use crate::imu::simulate_imu;
use crate::layout;
use crate::photometry::Photometry;
use crate::render::{ROLLING_TILE, RayTable, TILE, expose};
use crate::rig;
use crate::scan::{ObservingFrame, Scan, scan_observed_surface};
use crate::schedule::{Shot, shots};
use crate::simulation::{CONFIG_FILE, FLIGHT_FILE, flight_list};
use crate::stabiliser::Stabiliser;
use crate::staging::{Staging, make_folder};
use crate::truth::{TRUTH_FILE, truth_text};
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
    /// Rows of imu0.
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

/// Called with the number of frames done and of all frames, from several threads; `false` stops the work.
pub type Progress<'a> = dyn Fn(usize, usize) -> bool + Sync + 'a;

/// Writes the sequence that `config` describes to `out/mav0`, the configuration to `out/synth.toml`, the device's true
/// parameters to `out/truth.json` and a given flight to `out/flight.csv`; [`crate::Simulation::open`] brings all of it back.
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
    let shots = shots(config, &path);
    let staging = Staging::new(out)?;
    if !progress(0, shots.len()) {
        return Err(SynthError::Cancelled);
    }
    let world = World::build(config, &path)?;
    let writer = Writer {
        config,
        path: &path,
        world: &world,
        camera: config.camera()?,
        shots: &shots,
        body_from_camera: config.body_from_camera(),
        mav: staging.folder.join("mav0"),
    };
    let observing = writer.write_frames(progress)?;
    writer.write_camera_texts()?;
    let imu_samples = writer.write_inertial()?;
    let scan_points = writer.write_scan(&observing)?;
    writer.write_config(&staging.folder, flight)?;
    let frames = shots.iter().map(|s| s.stamps.len()).sum();
    layout::write_text(&staging.folder.join(TRUTH_FILE), &truth_text(config, &writer.camera, &shots)?)?;
    if !progress(shots.len(), shots.len()) {
        return Err(SynthError::Cancelled);
    }
    staging.publish()?;
    Ok(SynthSummary {
        frames,
        imu_samples,
        scan_points,
        duration_secs: path.duration_secs(),
        path_length_m: path.path_length_m(),
        shapes: world.shape_count(),
    })
}

struct Writer<'a> {
    config: &'a SynthConfig,
    path: &'a FlightPath,
    world: &'a World,
    shots: &'a [Shot],
    camera: CameraModel,
    body_from_camera: Se3,
    mav: PathBuf,
}

impl Writer<'_> {
    /// Renders and writes all images and depths; returns what each frame saw.
    fn write_frames(&self, progress: &Progress<'_>) -> Result<Vec<ObservingFrame>, SynthError> {
        make_folder(&self.mav.join("cam0/data"))?;
        if self.config.depth {
            make_folder(&self.mav.join("depth0/data"))?;
        }
        let samples = self.config.blur_samples;
        let rays = RayTable::with_tiles(&self.camera, samples, self.tile());
        let stabiliser = self.stabiliser();
        let photometry = Photometry::new(self.config);
        let total = self.shots.len();
        let done = AtomicUsize::new(0);
        let cancelled = AtomicBool::new(false);
        let frame = |k: usize| {
            if cancelled.load(Ordering::Relaxed) {
                return Err(SynthError::Cancelled);
            }
            let shifted = stabiliser.as_ref().map(|stabiliser| self.shifted_rays(k, stabiliser));
            let frame_view = self.write_frame(k, shifted.as_ref().unwrap_or(&rays), &photometry)?;
            if !progress(done.fetch_add(1, Ordering::Relaxed) + 1, total) {
                cancelled.store(true, Ordering::Relaxed);
                return Err(SynthError::Cancelled);
            }
            Ok(frame_view)
        };
        (0..total).into_par_iter().with_max_len(1).map(frame).collect()
    }

    /// Columns and rows whose rays are cast together.
    fn tile(&self) -> [usize; 2] {
        if self.config.device.readout_secs > 0.0 { ROLLING_TILE } else { TILE }
    }

    fn stabiliser(&self) -> Option<Stabiliser> {
        let share = self.config.device.stabilisation;
        (share > 0.0).then(|| Stabiliser::new(self.path, &self.body_from_camera.rotation, share))
    }

    /// The rays of a stabilised image: the lens moves on from row to row.
    fn shifted_rays(&self, k: usize, stabiliser: &Stabiliser) -> RayTable {
        let shift_px = |row: usize| {
            let secs = self.shots[k].secs + self.row_delay(row as f64);
            stabiliser.shift(secs).component_mul(&self.camera.focal_lengths())
        };
        RayTable::shifted(&self.camera, self.config.blur_samples, self.tile(), shift_px)
    }

    fn write_frame(
        &self,
        k: usize,
        rays: &RayTable,
        photometry: &Photometry,
    ) -> Result<ObservingFrame, SynthError> {
        let config = self.config;
        let Shot { secs, stamps } = &self.shots[k];
        let exposed = if config.device.readout_secs > 0.0 {
            expose(self.world, rays, |s, band| {
                self.world_from_camera(
                    secs + self.row_delay(rays.middle_row(band)) + self.ray_delay(s, rays.centre()),
                )
            })
        } else {
            // One pose per ray of a pixel holds for every row.
            let poses: Vec<Se3> = (0..config.blur_samples)
                .map(|s| self.world_from_camera(secs + self.ray_delay(s, rays.centre())))
                .collect();
            expose(self.world, rays, |s, _| poses[s])
        };
        let image = photometry.develop(&exposed.radiance, k, *secs);
        for stamp in stamps {
            self.write_pictures(*stamp, &image, &exposed.depth)?;
        }
        Ok(ObservingFrame::new(&self.world_from_camera(*secs), &exposed.depth, config.width))
    }

    fn write_pictures(&self, stamp: Timestamp, image: &[u8], depth: &[f32]) -> Result<(), SynthError> {
        let (width, height) = (self.config.width, self.config.height);
        let file = self.mav.join("cam0/data").join(format!("{}.{}", stamp.nanos(), self.image_extension()));
        match self.config.device.jpeg_quality {
            0 => image_file::write_gray8(&file, width, height, image)?,
            quality => image_file::write_jpeg(&file, width, height, image, quality)?,
        }
        if self.config.depth {
            let units = f64::from(self.depth_units_per_metre());
            let encode = |&z: &f32| {
                let value = (f64::from(z) * units).round();
                // NaN and what lies beyond the range are 0: no depth.
                if value >= 1.0 && value <= f64::from(u16::MAX) { value as u16 } else { 0 }
            };
            let depth: Vec<u16> = depth.iter().map(encode).collect();
            let file = self.mav.join("depth0/data").join(format!("{}.png", stamp.nanos()));
            image_file::write_gray16(&file, width, height, &depth)?;
        }
        Ok(())
    }

    fn image_extension(&self) -> &'static str {
        if self.config.device.jpeg_quality > 0 { "jpg" } else { "png" }
    }

    fn world_from_camera(&self, secs: f64) -> Se3 {
        self.path.world_from_body(secs) * self.body_from_camera
    }

    /// When ray `sample` of a pixel is cast, relative to the middle of the exposure, s; that of `centre` is in it.
    fn ray_delay(&self, sample: usize, centre: usize) -> f64 {
        self.config.exposure_secs * (sample as f64 - centre as f64) / self.config.blur_samples as f64
    }

    /// When `row` is exposed, relative to the middle row, s.
    fn row_delay(&self, row: f64) -> f64 {
        (row / (self.config.height - 1) as f64 - 0.5) * self.config.device.readout_secs
    }

    /// The finest unit in which the longest sight line of the room fits 16 bits.
    fn depth_units_per_metre(&self) -> u32 {
        let room = self.world.extent();
        let longest = (room.max - room.min).norm();
        [5000, 2000, 1000, 500, 200].into_iter().find(|&u| longest * f64::from(u) < 65_535.0).unwrap_or(100)
    }

    fn write_camera_texts(&self) -> Result<(), SynthError> {
        let rate = self.config.camera_rate_hz;
        let mount = layout::mount_matrix(self.config);
        let stamps: Vec<Timestamp> = self.shots.iter().flat_map(|s| s.stamps.iter().copied()).collect();
        let folder = self.mav.join("cam0");
        layout::write_text(&folder.join("data.csv"), &layout::image_list(&stamps, self.image_extension()))?;
        let yaml = match self.config.device.calibration {
            CalibrationKind::Given => Some(layout::camera_yaml(&self.camera, Some(&mount), rate, None)),
            CalibrationKind::Partial => {
                Some(layout::camera_yaml(&self.config.partial_camera(&self.camera)?, None, rate, None))
            }
            CalibrationKind::Absent => None,
        };
        if let Some(yaml) = yaml {
            layout::write_text(&folder.join("sensor.yaml"), &yaml)?;
        }
        if self.config.depth {
            let folder = self.mav.join("depth0");
            layout::write_text(&folder.join("data.csv"), &layout::image_list(&stamps, "png"))?;
            let units = Some(self.depth_units_per_metre());
            let yaml = layout::camera_yaml(&self.camera, Some(&mount), rate, units);
            layout::write_text(&folder.join("sensor.yaml"), &yaml)?;
        }
        Ok(())
    }

    fn write_inertial(&self) -> Result<usize, SynthError> {
        let record = simulate_imu(self.path, self.config);
        let imu = self.mav.join("imu0");
        make_folder(&imu)?;
        layout::write_text(&imu.join("data.csv"), &layout::imu_list(&record))?;
        if self.config.device.calibration == CalibrationKind::Given {
            layout::write_text(&imu.join("sensor.yaml"), &layout::imu_yaml(self.config))?;
        }
        let truth = self.mav.join("state_groundtruth_estimate0");
        make_folder(&truth)?;
        let list = layout::truth_list(self.path, &record);
        layout::write_text(&truth.join("data.csv"), &list)?;
        let yaml = layout::plain_yaml("visual-inertial", "exact state of the simulated body");
        layout::write_text(&truth.join("sensor.yaml"), &yaml)?;
        Ok(record.samples.len())
    }

    fn write_scan(&self, observing: &[ObservingFrame]) -> Result<usize, SynthError> {
        let config = self.config;
        let scan = Scan { seed: config.seed, spacing_m: config.scan_spacing_m, noise_m: config.scan_noise_m };
        let points = scan_observed_surface(self.world, &self.camera, observing, &scan)?;
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
            // Poses of the body, so that the sequence can be simulated again whatever frame the trajectory had.
            let flown = flown.in_frame(BodyFrame::Imu, &rig::rig(self.config)?)?;
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
