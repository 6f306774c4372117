//! Flights to start on: the EuRoC ones as smooth curves.

use nalgebra::Vector3;
use vidar_core::{BodyFrame, Se3, So3, StampedPose, Timestamp, Trajectory};
use vidar_odometry::simulate::{Flight, Motion};
use vidar_synth::{FlightPath, Start, SynthConfig};

pub const FLIGHTS: [&str; 11] =
    ["MH_01", "MH_02", "MH_03", "MH_04", "MH_05", "V1_01", "V1_02", "V1_03", "V2_01", "V2_02", "V2_03"];

pub struct Flown(pub FlightPath);

impl Flight for Flown {
    fn motion(&self, secs: f64) -> Motion {
        let state = self.0.state(secs);
        Motion {
            world_from_body: state.world_from_body,
            velocity: state.velocity_in_world,
            acceleration: state.acceleration_in_world,
            angular_rate: state.angular_rate,
        }
    }

    fn duration_secs(&self) -> f64 {
        self.0.duration_secs()
    }
}

/// Poses of a EuRoC flight; `None` where the data is absent, which is told.
pub fn euroc_poses(name: &str) -> Option<Vec<StampedPose>> {
    let path = vidar_core::testing::shared_data(&format!(
        "data/rpg_reference_trajectories/euroc_vislam_mono/laptop/vislam_rp/laptop_vislam_rp_{name}/stamped_traj_estimate0.txt"
    ))?;
    let text = std::fs::read_to_string(path).unwrap();
    let mut poses: Vec<StampedPose> = Vec::new();
    for line in text.lines().filter(|l| !l.starts_with('#') && !l.trim().is_empty()) {
        let words: Vec<&str> = line.split_whitespace().collect();
        let n: Vec<f64> = words[1..].iter().map(|w| w.parse().unwrap()).collect();
        let time = Timestamp::parse_secs(words[0]).unwrap();
        if poses.last().is_some_and(|p| p.time >= time) {
            continue;
        }
        let rotation = So3::from_quaternion(n[3], n[4], n[5], n[6]).unwrap();
        let world_from_body = Se3::new(rotation, Vector3::new(n[0], n[1], n[2]));
        poses.push(StampedPose { time, world_from_body });
    }
    Some(poses)
}

/// The longest gap within a curve, s.
const MAX_GAP_SECS: f64 = 1.0;

/// Stretches of poses without gaps.
pub fn stretches(poses: &[StampedPose]) -> impl Iterator<Item = &[StampedPose]> {
    poses.chunk_by(|a, b| (b.time - a.time).as_secs_f64() < MAX_GAP_SECS)
}

/// A smooth curve through poses, flown from its beginning or after a rest there.
pub fn flown(poses: &[StampedPose], start: Start) -> Flown {
    let trajectory = Trajectory::new(BodyFrame::Imu, poses.to_vec()).unwrap();
    let config = SynthConfig { start, duration_secs: 3600.0, ..SynthConfig::default() };
    Flown(FlightPath::from_trajectory(&trajectory, &config).unwrap())
}

/// The flights asked for, with their poses.
pub fn chosen_flights() -> Option<Vec<(&'static str, Vec<StampedPose>)>> {
    let wanted = std::env::var("VIDAR_FLIGHTS").unwrap_or_default();
    let names = FLIGHTS.into_iter().filter(|n| wanted.is_empty() || wanted.split(',').any(|w| w == *n));
    names.map(|n| Some((n, euroc_poses(n)?))).collect()
}

pub fn length_secs(poses: &[StampedPose]) -> f64 {
    (poses[poses.len() - 1].time - poses[0].time).as_secs_f64()
}
