//! The real recordings in `shared/data`, if they are present.

use std::path::PathBuf;
use vidar_core::{BodyFrame, CameraId, SensorEvent};
use vidar_dataset::{
    CalibrationSource, CameraFlag, OpenOptions, Recording, RecordingKind, TrajectoryReadOptions, open,
    read_trajectory,
};

fn shared(part: &str) -> Option<PathBuf> {
    vidar_core::testing::shared_data(&format!("data/{part}"))
}

/// What identifies a dataset.
fn fingerprint(dataset: &Recording) -> Vec<u8> {
    let mut bytes = Vec::new();
    dataset.write_fingerprint(&mut bytes).unwrap();
    bytes
}

fn kinds(dataset: &Recording) -> Vec<&str> {
    dataset.warnings.iter().map(|w| w.kind.as_str()).collect()
}

#[test]
fn euroc_mh_01_opens_with_everything_it_has() {
    let Some(path) = shared("euroc_MH_01_real_11s") else { return };
    let d = open(&path, &OpenOptions::default()).unwrap();
    assert_eq!((d.kind, d.name.as_str()), (RecordingKind::EurocAsl, "euroc_MH_01_real_11s"));
    assert_eq!((d.images.len(), d.rig.cameras.len(), d.camera), (220, 2, CameraId(0)));
    assert_eq!(d.images[0].time.nanos(), 1_403_636_584_763_555_584);
    let camera = d.rig.camera(d.camera).unwrap();
    assert_eq!(camera.model.name(), "pinhole-radtan");
    assert!((camera.body_from_camera.translation.x + 0.021_640_145_497_5).abs() < 1e-12);
    assert!(d.imu.len() > 2500 && d.rig.imu.is_some());
    let truth = d.ground_truth.as_ref().unwrap();
    assert_eq!(truth.body(), BodyFrame::Imu);
    assert!((truth.poses()[0].world_from_body.translation.x - 4.698_707).abs() < 1e-12);
    assert_eq!(d.load_image(&d.images[0]).unwrap().width(), 752);
    for kind in
        ["gravity-norm", "unit-slip", "time-duplicate", "time-not-increasing", "imu-gap", "no-overlap"]
    {
        assert!(!kinds(&d).contains(&kind), "{:?}", d.warnings);
    }

    for inner in ["mav0", "mav0/cam0"] {
        let same = open(&path.join(inner), &OpenOptions::default()).unwrap();
        assert_eq!(
            (same.images.len(), same.imu.len(), same.name),
            (220, d.imu.len(), d.name.clone()),
            "{inner}"
        );
    }
    let right = open(&path.join("mav0/cam1"), &OpenOptions::default()).unwrap();
    assert_eq!((right.camera, right.images.len()), (CameraId(1), 22));
    assert!(fingerprint(&right) == fingerprint(&right));
    assert!(fingerprint(&right) != fingerprint(&d));
}

#[test]
fn events_of_the_real_flight_are_ordered_and_imu_samples_come_first() {
    let Some(path) = shared("euroc_MH_01_real_11s") else { return };
    let options = OpenOptions { end: Some(vidar_core::Duration::from_millis(500)), ..Default::default() };
    let d = open(&path, &options).unwrap();
    assert_eq!(d.images.len(), 11);
    let events: Vec<SensorEvent> = d.events().collect::<Result<_, _>>().unwrap();
    assert!(events.windows(2).all(|w| w[0].time() <= w[1].time()));
    for w in events.windows(2) {
        if w[0].time() == w[1].time() {
            assert!(!matches!(w[1], SensorEvent::Imu(_)), "an IMU sample comes first at {}", w[0].time());
        }
    }
    assert_eq!(events.iter().filter(|e| matches!(e, SensorEvent::Image(_))).count(), 11);
}

#[test]
fn seven_scenes_red_kitchen_opens_as_rgbd_with_metric_poses() {
    let Some(path) = shared("7scenes_redkitchen") else { return };
    let d = open(&path, &OpenOptions::default()).unwrap();
    assert_eq!((d.kind, d.images.len(), d.depths.len()), (RecordingKind::SevenScenes, 125, 125));
    assert_eq!(d.name, "7scenes_redkitchen-seq-01");
    let truth = d.ground_truth.as_ref().unwrap();
    assert_eq!((truth.body(), truth.len()), (BodyFrame::Camera(CameraId(0)), 125));
    assert!(kinds(&d).contains(&"times-synthesised") && kinds(&d).contains(&"color-is-depth-camera"));
    let sensor = d.depth_sensor.as_ref().unwrap();
    assert_eq!((sensor.intrinsics.fx, sensor.intrinsics.cx, sensor.units_per_metre), (585.0, 320.0, 1000.0));
    assert!((d.images[1].time - d.images[0].time).nanos() - 66_666_666 <= 1);
    let depth = d.load_depth(d.depth_for(d.images[3].time).unwrap()).unwrap();
    assert!(depth.valid_ratio() > 0.5);
    let farthest = depth.image().data().iter().filter(|z| !z.is_nan()).fold(0.0_f32, |a, &z| a.max(z));
    assert!(farthest < 20.0, "65535 is no depth: {farthest}");

    let colour = "pinhole:523.5,523.5,319.8,233.5".parse::<CameraFlag>().unwrap();
    let d = open(&path.join("seq-01"), &OpenOptions { camera_model: Some(colour.0), ..Default::default() })
        .unwrap();
    assert_eq!(d.calibration, CalibrationSource::Flags);
    assert_eq!(d.rig.camera(d.camera).unwrap().model.intrinsics().fx, 523.5);
    assert_eq!(d.depth_sensor.as_ref().unwrap().intrinsics.fx, 585.0);
    assert!(kinds(&d).contains(&"depth-extrinsics") && !kinds(&d).contains(&"color-is-depth-camera"));
}

#[test]
fn the_hololens_room_opens_with_poses_line_by_line() {
    let Some(path) = shared("hololens_commonroom") else { return };
    let d = open(&path, &OpenOptions::default()).unwrap();
    assert_eq!((d.kind, d.images.len(), d.depths.len()), (RecordingKind::PosedFolder, 48, 48));
    let truth = d.ground_truth.as_ref().unwrap();
    assert!((truth.poses()[0].world_from_body.translation.z - 4.67999).abs() < 1e-9);
    assert!((d.rig.cameras[0].model.intrinsics().fx - 495.567_757).abs() < 1e-6);
    assert!(d.load_depth(&d.depths[0]).unwrap().valid_ratio() > 0.1);
}

#[test]
fn bare_tum_frames_open_as_images_with_times_from_their_names() {
    let Some(path) = shared("tum_fr3_office_1hz") else { return };
    let d = open(&path, &OpenOptions::default()).unwrap();
    assert_eq!((d.kind, d.images.len()), (RecordingKind::ImageFolder, 17));
    assert_eq!(d.images[0].time.nanos(), 1_341_847_980_722_988_000);
    assert_eq!(d.calibration, CalibrationSource::DatasetDefault);
    assert_eq!(d.rig.cameras[0].model.intrinsics().fx, 535.4);
    assert!(kinds(&d).contains(&"intrinsics-published") && kinds(&d).contains(&"time-unit"));
}

#[test]
fn every_published_estimate_is_a_trajectory() {
    let Some(path) = shared("rpg_reference_trajectories") else { return };
    let mut folders = vec![path];
    let mut read = 0;
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|e| e == "txt") {
                let (trajectory, _) = read_trajectory(&path, &TrajectoryReadOptions::default())
                    .unwrap_or_else(|e| panic!("{}: {e}", path.display()));
                assert!(trajectory.len() > 100, "{}", path.display());
                read += 1;
            }
        }
    }
    assert!(read > 40, "{read}");
}

#[test]
fn real_euroc_survives_two_conversions() {
    use vidar_dataset::convert::{ConvertFormat, convert};
    let Some(path) = shared("euroc_MH_01_real_11s") else { return };
    let options = OpenOptions { end: Some(vidar_core::Duration::from_millis(2000)), ..Default::default() };
    let first = open(&path, &options).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let (bag, again) = (folder.path().join("a.mcap"), folder.path().join("b"));
    convert(&first, &bag, ConvertFormat::Mcap, &|_, _| true).unwrap();
    let middle = open(&bag, &OpenOptions::default()).unwrap();
    convert(&middle, &again, ConvertFormat::Euroc, &|_, _| true).unwrap();
    let last = open(&again, &OpenOptions::default()).unwrap();
    assert!(first.images.len() >= 40 && first.imu.len() > 900, "{} {}", first.images.len(), first.imu.len());
    assert!(first.imu == last.imu && first.rig.imu == last.rig.imu);
    assert_eq!(first.rig.camera(first.camera).unwrap().model, last.rig.camera(last.camera).unwrap().model);
    assert_eq!(first.images.len(), last.images.len());
    for (a, b) in first.images.iter().zip(&last.images) {
        assert_eq!(a.time, b.time);
        assert!(first.load_image(a).unwrap() == last.load_image(b).unwrap());
    }
    assert_eq!(first.ground_truth.unwrap().len(), last.ground_truth.unwrap().len());
}
