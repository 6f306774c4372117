//! IMU measurements that are missing or saturated, clocks and places that are wrong.

use super::recording::{EPOCH, Recording, add_noise, lost, recording, within};
use nalgebra::Vector3;
use vidar_core::{Duration, Health, LieGroup, Se3, So3};
use vidar_odometry::{OdometryOutput, Status};

#[test]
fn a_gap_of_imu_samples_is_bridged() {
    let mut recording = recording();
    let from = EPOCH + Duration::from_millis(5010);
    recording.imu.retain(|s| s.time < from || s.time > from + Duration::from_millis(100));
    let (outputs, odometry) = recording.run_events(recording.events());
    within("100 ms without IMU measurements", &recording, &outputs, 0.05);
    assert!(odometry.counts().imu_gaps >= 1 && lost(&outputs).is_empty());
}

#[test]
fn a_second_without_imu_samples_is_a_loss_with_its_reason_and_a_new_segment() {
    let mut recording = recording();
    let from = EPOCH + Duration::from_millis(4010);
    recording.imu.retain(|s| s.time < from || s.time > from + Duration::from_millis(1000));
    let outputs = recording.run();
    let reasons = lost(&outputs);
    assert!(reasons.len() == 1 && reasons[0].starts_with("no IMU measurement for 1.0"), "{reasons:?}");
    let segments: Vec<u32> = outputs.iter().filter_map(|o| Some(o.tracking()?.segment)).collect();
    assert!(segments.first() == Some(&0) && segments.iter().all(|s| *s <= 1), "{segments:?}");
}

#[test]
fn a_saturated_gyroscope_is_not_used() {
    let mut recording = recording();
    let from = EPOCH + Duration::from_millis(5010);
    for sample in &mut recording.imu {
        if sample.time >= from && sample.time < from + Duration::from_millis(60) {
            sample.gyro.0 = Vector3::new(17.4, -17.4, 17.4);
        }
    }
    let outputs = recording.run();
    assert!(lost(&outputs).is_empty(), "{:?}", lost(&outputs));
    within("gyroscope saturated for 60 ms", &recording, &outputs, 0.02);
}

fn inverted() -> Recording {
    let mut recording = recording();
    let place = &mut recording.rig.cameras[0].body_from_camera;
    *place = Se3::new(place.rotation.inverse(), place.translation);
    recording
}

#[test]
fn an_inverted_extrinsic_is_rejected_with_its_reason_whatever_the_image_noise() {
    for draw in 0..3 {
        let mut recording = inverted();
        for (k, (_, image)) in recording.images.iter_mut().enumerate() {
            *image = add_noise(image, 1.0, 1000 * (draw + 1) + k as u64);
        }
        let outputs = recording.run();
        let healthy = outputs.iter().filter(|o| o.health() == Health::Ok).count();
        assert!(healthy < outputs.len() / 20, "draw {draw}: {healthy} of {}", outputs.len());
        let is_said = |o: &OdometryOutput| match &o.status {
            Status::Waiting(failure) => failure.to_string().contains("orientation on the IMU"),
            Status::Lost(reason) => reason.to_string().contains("gyroscope and images disagree"),
            Status::Tracking(_) => false,
        };
        let first = outputs.iter().position(is_said);
        assert!(
            first.is_some_and(|k| k < 100),
            "draw {draw}: {first:?}, {:?}",
            outputs.last().unwrap().status
        );
    }
}

/// Images that are stamped `millis` too late.
fn late(millis: i64) -> Recording {
    let mut recording = recording();
    recording.images.iter_mut().for_each(|(time, _)| *time = *time + Duration::from_millis(millis));
    recording.images.retain(|(time, _)| *time > EPOCH);
    recording.truth.iter_mut().for_each(|p| p.time = p.time + Duration::from_millis(millis));
    recording
}

#[test]
#[ignore = "long form: cargo test --release -p vidar-odometry --test flights ladder -- --ignored"]
fn clocks_may_differ_by_20_ms() {
    for millis in [-20, -10, 10, 20] {
        let recording = late(millis);
        let outputs = recording.run();
        assert!(lost(&outputs).is_empty(), "{millis} ms: {:?}", lost(&outputs));
        let (ate, share) = recording.error_and_share(&format!("images stamped {millis} ms late"), &outputs);
        assert!(ate < 0.08 && share > 0.5, "{millis} ms: {ate} m, {share} of the images");
    }
}

#[test]
#[ignore = "long form: cargo test --release -p vidar-odometry --test flights ladder -- --ignored"]
fn the_camera_may_be_turned_by_2_degrees() {
    let mut recording = recording();
    let place = &mut recording.rig.cameras[0].body_from_camera;
    let off = So3::exp(&(Vector3::new(0.6, -0.6, 0.5).normalize() * 2.0_f64.to_radians()));
    *place = Se3::new(place.rotation * off, place.translation);
    recording.config.estimate_extrinsics = true;
    let outputs = recording.run();
    assert!(lost(&outputs).is_empty(), "{:?}", lost(&outputs));
    within("camera turned by 2°, estimated", &recording, &outputs, 0.08);
}
