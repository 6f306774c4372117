//! A simulated place and flight, made from settings or brought back from a written sequence.

use crate::config::SynthConfig;
use crate::error::SynthError;
use crate::flight::FlightPath;
use crate::stamps;
use crate::world::World;
use std::path::Path;
use vidar_core::{BodyFrame, Se3, StampedPose, Timestamp, Trajectory};

/// File of the settings in a sequence's folder.
pub(crate) const CONFIG_FILE: &str = "synth.toml";

/// File of the trajectory that was flown; absent after a built-in flight.
pub(crate) const FLIGHT_FILE: &str = "flight.csv";

/// Larger files are not ones that [`crate::write_sequence`] wrote: an hour at 1 kHz has 300 MB.
const MAX_BYTES: u64 = 512 << 20;

/// A world with the flight through it.
pub struct Simulation {
    config: SynthConfig,
    path: FlightPath,
    world: World,
}

impl Simulation {
    /// The simulation that [`crate::write_sequence`] would write.
    ///
    /// # Errors
    /// A bad configuration or trajectory.
    pub fn new(config: &SynthConfig, flight: Option<&Trajectory>) -> Result<Self, SynthError> {
        let path = FlightPath::new(config, flight)?;
        let world = World::build(config, &path)?;
        Ok(Self { config: config.clone(), path, world })
    }

    /// The simulation of which `folder` holds the sequence, from its `synth.toml` and, if there is one, `flight.csv`.
    ///
    /// # Errors
    /// Files that are missing, too large or not what [`crate::write_sequence`] writes.
    pub fn open(folder: &Path) -> Result<Self, SynthError> {
        let path = folder.join(CONFIG_FILE);
        let config: SynthConfig = toml::from_str(&text(&path)?)
            .map_err(|e| SynthError::BadSequence { path, reason: e.message().to_owned() })?;
        let flight = folder.join(FLIGHT_FILE);
        let flight = if flight.exists() { Some(read_flight(&flight)?) } else { None };
        Self::new(&config, flight.as_ref())
    }

    /// The settings.
    pub fn config(&self) -> &SynthConfig {
        &self.config
    }

    /// The flight.
    pub fn path(&self) -> &FlightPath {
        &self.path
    }

    /// The world.
    pub fn world(&self) -> &World {
        &self.world
    }

    /// Time of frame `k` on the IMU's clock, at an even frame rate.
    pub fn frame_time(&self, k: usize) -> Timestamp {
        stamps::stamp(k, self.config.camera_rate_hz).0
    }

    /// Exact pose of the body (IMU) at a stamp of the sequence; `None` before the first and after the last instant.
    pub fn world_from_body(&self, time: Timestamp) -> Option<Se3> {
        let secs = stamps::secs(time);
        // A frame's stamp may round past the end by half a nanosecond.
        let within = (-1e-6..=self.path.duration_secs() + 1e-6).contains(&secs);
        within.then(|| self.path.world_from_body(secs))
    }

    /// Exact pose of cam0 at the middle row of the image taken at `time` on the IMU's clock.
    pub fn world_from_camera(&self, time: Timestamp) -> Option<Se3> {
        Some(self.world_from_body(time)? * self.config.body_from_camera())
    }
}

fn text(path: &Path) -> Result<String, SynthError> {
    let read = |source| SynthError::Read { path: path.to_path_buf(), source };
    let found = std::fs::metadata(path).map_err(read)?.len();
    if found > MAX_BYTES {
        let reason = format!("it has {found} bytes, more than {MAX_BYTES}");
        return Err(SynthError::BadSequence { path: path.to_path_buf(), reason });
    }
    std::fs::read_to_string(path).map_err(read)
}

/// A trajectory of the body as text; every digit is kept.
pub(crate) fn flight_list(flight: &Trajectory) -> String {
    use std::fmt::Write as _;
    let mut text = String::from("#timestamp [ns],p_x [m],p_y [m],p_z [m],q_x [],q_y [],q_z [],q_w []\n");
    for pose in flight.poses() {
        let (p, [x, y, z, w]) =
            (pose.world_from_body.translation, pose.world_from_body.rotation.quaternion_xyzw());
        let _ = writeln!(text, "{},{},{},{},{x},{y},{z},{w}", pose.time.nanos(), p.x, p.y, p.z);
    }
    text
}

fn read_flight(path: &Path) -> Result<Trajectory, SynthError> {
    let bad = |reason: String| SynthError::BadSequence { path: path.to_path_buf(), reason };
    let text = text(path)?;
    let mut poses = Vec::new();
    for (number, line) in
        text.lines().enumerate().filter(|(_, l)| !l.starts_with('#') && !l.trim().is_empty())
    {
        let pose = flight_pose(line).ok_or_else(|| {
            bad(format!(
                "line {}: expected 8 numbers, found {:?}",
                number + 1,
                line.get(..80).unwrap_or(line)
            ))
        })?;
        poses.push(pose);
    }
    Trajectory::new(BodyFrame::Imu, poses).map_err(|e| bad(e.to_string()))
}

fn flight_pose(line: &str) -> Option<StampedPose> {
    let mut fields = line.split(',');
    let nanos: i64 = fields.next()?.trim().parse().ok()?;
    let numbers: Vec<f64> = fields.map(|f| f.trim().parse().ok()).collect::<Option<_>>()?;
    let [px, py, pz, x, y, z, w] = numbers[..] else { return None };
    let rotation = vidar_core::So3::from_quaternion(x, y, z, w)?;
    let world_from_body = Se3::new(rotation, nalgebra::Vector3::new(px, py, pz));
    Some(StampedPose { time: Timestamp::from_nanos(nanos), world_from_body })
}
