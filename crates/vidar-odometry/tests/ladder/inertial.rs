//! IMU measurements that are missing or saturated, clocks and places that are wrong.

use crate::recording::{EPOCH, Recording, lost, recording, within};
use nalgebra::Vector3;
use vidar_core::{Duration, Health, LieGroup, Se3, So3};

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
    within("gyroscope saturated for 60 ms", &recording, &outputs, 0.05);
}

fn inverted() -> Recording {
    let mut recording = recording();
    let place = &mut recording.rig.cameras[0].body_from_camera;
    *place = Se3::new(place.rotation.inverse(), place.translation);
    recording
}

#[test]
fn an_inverted_extrinsic_is_rejected_with_its_reason() {
    let outputs = inverted().run();
    let healthy = outputs.iter().filter(|o| o.health() == Health::Ok).count();
    assert!(healthy < outputs.len() / 20, "{healthy} of {}", outputs.len());
    let said = outputs.iter().any(|o| match &o.status {
        vidar_odometry::Status::Waiting(failure) => failure.to_string().contains("orientation on the IMU"),
        vidar_odometry::Status::Lost(reason) => reason.to_string().contains("gyroscope and images disagree"),
        vidar_odometry::Status::Tracking(_) => false,
    });
    assert!(said, "{:?}", outputs.last().unwrap().status);
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
#[ignore = "long form: cargo test --release -p vidar-odometry --test ladder -- --ignored"]
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
#[ignore = "long form: cargo test --release -p vidar-odometry --test ladder -- --ignored"]
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
