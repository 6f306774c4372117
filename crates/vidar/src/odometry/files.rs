//! Files of `vidar odometry`.

use super::{OdometryOutcome, Tracked, map};
use crate::error::Error;
use crate::events::{Event, Events};
use crate::run_folder::{RunFolder, pretty};
use serde_json::{Value, json};
use std::fmt::Write as _;
use vidar_core::{OdometryKeyframe, Se3, StampedPose, Trajectory};
use vidar_odometry::{OdometryOutput, Status};

/// Schema of `odometry/keyframes.json`.
const KEYFRAMES_SCHEMA: &str = "vidar.odometry-keyframes/1";

/// Writes everything but the manifest; names of the files made.
pub(super) fn write(
    outcome: &OdometryOutcome,
    folder: &RunFolder,
    events: &Events,
) -> Result<Vec<String>, Error> {
    let mut made = vec!["config.resolved.toml".to_owned()];
    let mut put = |name: &str, bytes: &[u8]| -> Result<(), Error> {
        let bytes = folder.write(name, bytes)?;
        events.emit(&Event::ArtifactWritten { path: name.to_owned(), bytes });
        made.push(name.to_owned());
        Ok(())
    };
    let tracked = &outcome.tracked;
    let unit = if outcome.scale.is_metric { "metres" } else { "lengths are not metres" };
    let note = format!("vidar odometry, {unit}");
    if let Some(trajectory) = &outcome.trajectory {
        put_trajectory(&mut put, "trajectory/odometry_body", trajectory, &note)?;
    }
    if let Some(trajectory) = &outcome.final_trajectory {
        put_trajectory(
            &mut put,
            "trajectory/final_body",
            trajectory,
            &format!("{note}, adjusted after the end"),
        )?;
    }
    if let Some(keyframes) = keyframe_trajectory(&tracked.keyframes) {
        put_trajectory(&mut put, "trajectory/odometry_keyframes_camera", &keyframes, &note)?;
    }
    put("odometry/keyframes.json", &pretty(&keyframes_json(outcome))?)?;
    put("odometry/landmarks.csv", landmarks_csv(&tracked.keyframes).as_bytes())?;
    put("odometry/health.csv", health_csv(tracked).as_bytes())?;
    put("odometry/report.json", &pretty(&outcome.result_json())?)?;
    if let Some((name, bytes)) = map::write(folder, &tracked.saved_map)? {
        events.emit(&Event::ArtifactWritten { path: name.to_owned(), bytes });
        made.push(name.to_owned());
    }
    Ok(made)
}

fn put_trajectory(
    put: &mut impl FnMut(&str, &[u8]) -> Result<(), Error>,
    stem: &str,
    trajectory: &Trajectory,
    note: &str,
) -> Result<(), Error> {
    let mut bytes = Vec::new();
    vidar_export::write_tum(&mut bytes, trajectory, note)?;
    put(&format!("{stem}.tum"), &bytes)?;
    bytes.clear();
    vidar_export::write_euroc_csv(&mut bytes, trajectory, note)?;
    put(&format!("{stem}.euroc.csv"), &bytes)
}

/// Poses of the newest segment's keyframes, as poses of the camera.
fn keyframe_trajectory(keyframes: &[OdometryKeyframe]) -> Option<Trajectory> {
    let segment = keyframes.last()?.segment;
    let poses = keyframes
        .iter()
        .filter(|k| k.segment == segment)
        .map(|k| StampedPose { time: k.state.time, world_from_body: k.world_from_camera })
        .collect();
    Trajectory::new(vidar_core::BodyFrame::Camera(vidar_core::CameraId(0)), poses).ok()
}

fn keyframes_json(outcome: &OdometryOutcome) -> Value {
    let tracked = &outcome.tracked;
    let one = |k: &OdometryKeyframe| {
        let previous = k
            .previous
            .as_ref()
            .map(|(id, covariance)| json!({ "id": id, "covariance": rows(covariance.as_slice(), 6) }));
        json!({
            "id": k.id, "frame": k.frame_id, "segment": k.segment, "time_ns": k.state.time.nanos(),
            "world_from_camera": matrix(&k.world_from_camera),
            "pose_covariance": rows(k.pose_covariance.as_slice(), 6),
            "previous": previous,
            "gravity_in_world": k.gravity_in_world.as_slice(),
            "scale_std": finite(k.scale_std),
            "health": k.health.as_str(), "landmarks": k.landmarks.len(),
        })
    };
    let all: Vec<Value> = tracked.keyframes.iter().map(one).collect();
    json!({ "schema": KEYFRAMES_SCHEMA, "is_metric": outcome.scale.is_metric, "keyframes": all })
}

/// Rows of a symmetric matrix of `n` columns.
fn rows(values: &[f64], n: usize) -> Vec<&[f64]> {
    values.chunks(n).collect()
}

fn matrix(pose: &Se3) -> [[f64; 4]; 3] {
    let (r, t) = (pose.rotation.matrix(), pose.translation);
    [0, 1, 2].map(|i| [r[(i, 0)], r[(i, 1)], r[(i, 2)], t[i]])
}

/// JSON has no infinity: unknown is null.
fn finite(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

fn landmarks_csv(keyframes: &[OdometryKeyframe]) -> String {
    let mut text = String::from("#keyframe,landmark,u_px,v_px,inverse_depth_per_m,inverse_depth_std_per_m\n");
    for keyframe in keyframes {
        for l in &keyframe.landmarks {
            let (u, v) = (l.pixel.x, l.pixel.y);
            let _ = writeln!(
                text,
                "{},{},{u:.3},{v:.3},{:.6},{:.6}",
                keyframe.id, l.id, l.inverse_depth, l.inverse_depth_std
            );
        }
    }
    text
}

/// The word of an image: its health, or that it waited.
pub(super) fn word(output: &OdometryOutput) -> &'static str {
    match &output.status {
        Status::Waiting(_) => "waiting",
        Status::Tracking(tracking) => tracking.health.as_str(),
        Status::Lost(_) => "lost",
    }
}

fn health_csv(tracked: &Tracked) -> String {
    let mut text = String::from(
        "#time_ns,frame,health,segment,landmarks,scale_std,position_std_m,rotation_std_deg,\
         gyro_bias_x,gyro_bias_y,gyro_bias_z,accel_bias_x,accel_bias_y,accel_bias_z,milliseconds,why\n",
    );
    for frame in &tracked.frames {
        let output = &frame.output;
        let _ = write!(text, "{},{},{}", output.time.nanos(), output.frame_id, word(output));
        match &output.status {
            Status::Tracking(t) => {
                let sigma =
                    |at: usize| (0..3).map(|k| t.covariance[(at + k, at + k)]).sum::<f64>().max(0.0).sqrt();
                let (g, a) = (t.state.gyro_bias, t.state.accel_bias);
                let scale = finite(t.scale_std).map_or_else(String::new, |s| format!("{s:.6}"));
                let _ = write!(
                    text,
                    ",{},{},{scale},{:.6},{:.5},{:.6},{:.6},{:.6},{:.5},{:.5},{:.5},{:.3},",
                    t.segment,
                    t.tracked,
                    sigma(3),
                    sigma(0).to_degrees(),
                    g.x,
                    g.y,
                    g.z,
                    a.x,
                    a.y,
                    a.z,
                    1e3 * frame.seconds
                );
            }
            Status::Waiting(failure) => {
                let _ = write!(text, ",,,,,,,,,,,,{:.3},\"{failure}\"", 1e3 * frame.seconds);
            }
            Status::Lost(reason) => {
                let _ = write!(text, ",,,,,,,,,,,,{:.3},\"{reason}\"", 1e3 * frame.seconds);
            }
        }
        text.push('\n');
    }
    text
}

/// Median and 95th percentile of the time per image, ms.
pub(super) fn milliseconds(tracked: &Tracked) -> Value {
    let mut all: Vec<f64> = tracked.frames.iter().map(|f| 1e3 * f.seconds).collect();
    all.sort_unstable_by(f64::total_cmp);
    let at = |share: f64| all.get(((all.len().max(1) - 1) as f64 * share) as usize).copied();
    json!({ "median": at(0.5), "p95": at(0.95) })
}
