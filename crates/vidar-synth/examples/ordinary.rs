//! Renders ordinary hand-held recordings: `ordinary OUT [--tumvi FOLDER] NAME...`.
//!
//! A recording that needs a TUM-VI room reads `FOLDER/dataset-roomN_512_16/mav0/mocap0/data.csv`.

use std::error::Error;
use std::path::Path;
use std::time::Instant;
use vidar_core::{BodyFrame, Se3, So3, StampedPose, Timestamp, Trajectory};
use vidar_synth::{SynthConfig, write_sequence};

/// A recording of the set.
struct Recording {
    name: &'static str,
    config: SynthConfig,
    /// Room of TUM-VI whose path is taken.
    room: Option<u32>,
}

fn recordings() -> Vec<Recording> {
    vec![
        Recording { name: "phone_slow", config: SynthConfig::phone_slow(), room: None },
        Recording { name: "phone_fast", config: SynthConfig::phone_fast(), room: None },
        Recording { name: "tumvi_room1", config: SynthConfig::tumvi(), room: Some(1) },
        Recording { name: "realsense_like", config: SynthConfig::realsense(), room: None },
    ]
}

#[allow(clippy::print_stdout)] // printing is this program's whole purpose
fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let out = args.next().ok_or("usage: ordinary OUT [--tumvi FOLDER] NAME...")?;
    let mut rest: Vec<String> = args.collect();
    let mut tumvi = None;
    if rest.first().is_some_and(|a| a == "--tumvi") && rest.len() > 1 {
        tumvi = Some(rest.remove(1));
        rest.remove(0);
    }
    for recording in recordings() {
        if !rest.is_empty() && !rest.iter().any(|name| name == recording.name) {
            continue;
        }
        let folder = Path::new(&out).join(recording.name);
        if folder.join("mav0").exists() {
            println!("{}: there already", recording.name);
            continue;
        }
        let flight = match recording.room {
            None => None,
            Some(room) => {
                let root = tumvi.as_ref().ok_or("--tumvi FOLDER is needed")?;
                let file = format!("{root}/dataset-room{room}_512_16/mav0/mocap0/data.csv");
                Some(read_poses(Path::new(&file))?)
            }
        };
        let begin = Instant::now();
        let summary = write_sequence(&folder, &recording.config, flight.as_ref(), &|_, _| true)?;
        println!(
            "{}: {} frames, {:.1} s, path {:.2} m, rendered in {:.0} s",
            recording.name,
            summary.frames,
            summary.duration_secs,
            summary.path_length_m,
            begin.elapsed().as_secs_f64()
        );
    }
    Ok(())
}

/// Poses of the IMU: time (ns), position, quaternion with w first.
fn read_poses(path: &Path) -> Result<Trajectory, Box<dyn Error>> {
    let text = std::fs::read_to_string(path).map_err(|e| format!("{}: {e}", path.display()))?;
    let mut poses = Vec::new();
    for line in text.lines().filter(|l| !l.starts_with('#') && !l.trim().is_empty()) {
        let (time, rest) = line.split_once(',').ok_or("a line without commas")?;
        let v = rest.split(',').map(|f| f.trim().parse()).collect::<Result<Vec<f64>, _>>()?;
        let [x, y, z, qw, qx, qy, qz] = v[..] else { return Err("expected 8 columns".into()) };
        let rotation = So3::from_quaternion(qx, qy, qz, qw).ok_or("a quaternion of zero length")?;
        let time = Timestamp::from_nanos(time.trim().parse()?);
        let world_from_body = Se3::new(rotation, nalgebra::Vector3::new(x, y, z));
        poses.push(StampedPose { time, world_from_body });
    }
    Ok(Trajectory::new(BodyFrame::Imu, poses)?)
}
