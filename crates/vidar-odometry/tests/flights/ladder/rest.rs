//! Bodies that stand still: at the beginning, in the middle, for long.

use super::recording::{
    EPOCH, Recording, add_noise, lost, recording, rendered_after_creeping, rendered_from, sample_at_rest,
};
use nalgebra::Vector3;
use vidar_core::{AngularRate, Duration, ImuSample, LieGroup, StampedPose, Timestamp};
use vidar_odometry::OdometryOutput;
use vidar_synth::Start;

/// Largest distance from the first state within `from` and `until` seconds.
fn drift(outputs: &[OdometryOutput], from: f64, until: f64) -> f64 {
    let places: Vec<Vector3<f64>> = outputs
        .iter()
        .filter(|o| (from..until).contains(&(o.time - EPOCH).as_secs_f64()))
        .filter_map(|o| Some(o.tracking()?.state.world_from_body.translation))
        .collect();
    places.iter().map(|p| (p - places[0]).norm()).fold(0.0, f64::max)
}

fn stand(secs: i64) {
    let recording = recording().standing(secs);
    let outputs = recording.run();
    let states = outputs.iter().filter(|o| o.tracking().is_some()).count();
    assert!(states as i64 > 10 * secs - 20, "{states}");
    let far = drift(&outputs, 0.0, 1e9);
    eprintln!("| standing {secs} s | {far:.4} (drift) | | | | |");
    assert!(far < 0.02, "{far}");
    let bias = outputs.last().unwrap().tracking().unwrap().state.gyro_bias;
    assert!((bias - Vector3::new(0.01, 0.0, 0.0)).norm() < 1e-3, "{bias}");
}

#[test]
fn standing_still_does_not_drift() {
    stand(10);
}

#[test]
#[ignore = "long form: cargo test --release -p vidar-odometry --test flights ladder -- --ignored"]
fn standing_still_for_a_minute_does_not_drift() {
    stand(60);
}

/// A flight that comes to rest, stays for 4 s and more, and goes on: a start from rest, once backwards in time and once
/// forwards. Backwards, rates change their sign and forces do not.
fn with_a_pause(more_secs: i64) -> Recording {
    let forth = rendered_from(Start::Static { secs: 2.0 }, 6.0, 0.0, 1);
    let end = Duration::from_millis(6000);
    let back = |t: Timestamp| EPOCH + (end - (t - EPOCH));
    let on = |t: Timestamp| t + end + Duration::from_millis(1000 * more_secs);
    let mut all = Recording { images: Vec::new(), imu: Vec::new(), truth: Vec::new(), ..forth.clone() };
    let reversed = |s: &ImuSample| ImuSample { time: back(s.time), gyro: AngularRate(-s.gyro.0), ..*s };
    all.imu.extend(forth.imu.iter().rev().filter(|s| s.time <= EPOCH + end).map(reversed));
    all.images.extend(forth.images.iter().rev().map(|(t, i)| (back(*t), i.clone())));
    all.truth.extend(forth.truth.iter().rev().map(|p| StampedPose { time: back(p.time), ..*p }));
    let up = forth.truth[0].world_from_body.rotation.inverse() * Vector3::new(0.0, 0.0, 9.81);
    let begin = EPOCH + end;
    for k in 1..more_secs * 200 {
        let mut sample = sample_at_rest(begin + Duration::from_millis(5 * k), &up, k as u64);
        // The simulated IMU's bias there is small.
        sample.gyro.0.x -= 0.01;
        all.imu.push(sample);
    }
    for k in 1..more_secs * 20 {
        let time = begin + Duration::from_millis(50 * k);
        all.images.push((time, add_noise(&forth.images[0].1, 1.5, 77 + k as u64)));
        all.truth.push(StampedPose { time, ..forth.truth[0] });
    }
    let after = |t: Timestamp| t > EPOCH;
    all.imu.extend(forth.imu.iter().filter(|s| after(s.time)).map(|s| ImuSample { time: on(s.time), ..*s }));
    all.images.extend(forth.images.iter().filter(|i| after(i.0)).map(|(t, i)| (on(*t), i.clone())));
    all.truth
        .extend(forth.truth.iter().filter(|p| after(p.time)).map(|p| StampedPose { time: on(p.time), ..*p }));
    all
}

fn pause(more_secs: i64) {
    let recording = with_a_pause(more_secs);
    let outputs = recording.run();
    assert!(lost(&outputs).is_empty(), "{:?}", lost(&outputs));
    let far = drift(&outputs, 5.0, 7.0 + more_secs as f64);
    eprintln!("drift of {:.1} mm at rest", 1e3 * far);
    assert!(far < 0.02, "{far} m while standing");
    let (ate, share) =
        recording.error_and_share(&format!("a rest of {} s in flight", more_secs + 4), &outputs);
    assert!(ate < 0.05 && share > 0.6, "{ate} m, {share} of the images");
}

#[test]
fn a_pause_in_the_middle_of_a_flight_is_a_pause() {
    pause(0);
}

#[test]
#[ignore = "long form: cargo test --release -p vidar-odometry --test flights ladder -- --ignored"]
fn a_minute_of_rest_in_the_middle_of_a_flight_does_not_drift() {
    pause(60);
}

/// Too slow for a parallax that tells distances, too fast for a standstill: the accelerometer alone would carry the state away.
#[test]
fn a_body_that_creeps_after_a_rest_stays_where_it_is_until_it_flies() {
    let recording = rendered_after_creeping(8.0, 1.0, 0.0);
    let outputs = recording.run();
    assert!(lost(&outputs).is_empty(), "{:?}", lost(&outputs));
    let far = drift(&outputs, 0.0, 3.0);
    let (ate, share) = recording.error_and_share("creeping for 2 s after a rest", &outputs);
    eprintln!("{far:.4} m within the first three seconds");
    assert!(far < 0.03, "{far} m while it creeps");
    assert!(ate < 0.03 && share > 0.6, "{ate} m, {share} of the images");
}

/// A hand that holds a camera is never still to the IMU, and shows no parallax: the state begins all the same.
#[test]
fn a_trembling_hand_that_hardly_moves_has_a_state_after_a_second() {
    let mut recording = rendered_after_creeping(8.0, 0.5, 1.5e-3);
    // Clock and readout are known, as after a first pass over a recording.
    recording.config.align_timing = false;
    let outputs = recording.run();
    assert!(lost(&outputs).is_empty(), "{:?}", lost(&outputs));
    let first = outputs.iter().find(|o| o.tracking().is_some()).unwrap();
    let waited = (first.time - EPOCH).as_secs_f64();
    assert!((0.9..1.6).contains(&waited), "first state after {waited} s");
    assert!(first.tracking().unwrap().scale_std > 0.3, "nothing has told the scale yet");
    let far = drift(&outputs, 0.0, 2.5);
    let (ate, share) = recording.error_and_share("a hand that hardly moves for 2.5 s", &outputs);
    eprintln!("{far:.4} m within the first 2.5 seconds");
    assert!(far < 0.05, "{far} m while it hardly moves");
    assert!(ate < 0.03 && share > 0.6, "{ate} m, {share} of the images");
}
