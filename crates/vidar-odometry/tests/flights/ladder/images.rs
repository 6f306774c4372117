//! Images that are missing, repeated, dark, noisy, blurred or blank.

use super::recording::{add_noise, lost, recording, rendered, within};
use vidar_core::random::SplitMix64;
use vidar_core::{Health, Image};
use vidar_odometry::OdometryOutput;

#[test]
fn a_third_of_the_images_may_be_missing_from_the_first_on() {
    let mut recording = recording();
    let mut k = 0;
    recording.images.retain(|_| {
        k += 1;
        k % 3 != 0
    });
    let outputs = recording.run();
    let (ate, share) = recording.error_and_share("every third image missing", &outputs);
    assert!(ate < 0.05 && share > 0.5, "{ate} m, {share} of the images");
}

#[test]
#[ignore = "long form: cargo test --release -p vidar-odometry --test flights ladder -- --ignored"]
fn images_may_be_missing_by_chance() {
    for (seed, percent) in [(1_u64, 10), (2, 10), (3, 30), (4, 30), (5, 30)] {
        let mut recording = recording();
        let mut random = SplitMix64::new(seed);
        recording.images.retain(|_| random.below(100) >= percent);
        let outputs = recording.run();
        let (ate, share) = recording.error_and_share(&format!("{percent} % of the images missing"), &outputs);
        assert!(ate < 0.05 && share > 0.5, "{percent} % missing: {ate} m, {share} of the images");
    }
}

#[test]
fn repeated_images_are_left_out() {
    let mut recording = recording();
    for k in (90..110).step_by(2) {
        recording.images[k].1 = recording.images[k - 1].1.clone();
    }
    let (outputs, odometry) = recording.run_events(recording.events());
    assert_eq!(odometry.counts().images_repeated, 10);
    let degraded = outputs.iter().filter(|o| o.health() == Health::Degraded).count();
    assert!(degraded >= 10, "{degraded}");
    within("ten images repeated", &recording, &outputs, 0.05);
}

#[test]
fn a_second_without_texture_is_degraded_and_survived() {
    let mut recording = recording();
    for k in 95..115 {
        recording.images[k].1 = add_noise(&Image::filled(376, 240, 120), 1.5, k as u64);
    }
    let outputs = recording.run();
    assert!(outputs[98..114].iter().all(|o| o.health() == Health::Degraded), "no image helps");
    assert!(lost(&outputs).is_empty(), "{:?}", lost(&outputs));
    assert!(outputs[138].health().is_metric(), "{:?}", outputs[138].health());
    within("a second without texture", &recording, &outputs, 0.1);
}

/// However long it was before: keyframes of a window that sees nothing come every tenth image only.
#[test]
fn tracks_begin_again_as_soon_as_there_is_something_to_see() {
    for blank in [12, 14, 16, 18] {
        let mut recording = recording();
        let (from, until) = (95, 95 + blank);
        for k in from..until {
            recording.images[k].1 = add_noise(&Image::filled(376, 240, 120), 1.5, k as u64);
        }
        let outputs = recording.run();
        let sees = |o: &OdometryOutput| o.tracking().is_some_and(|t| t.tracked >= 15);
        let waited = outputs[until..].iter().position(sees).unwrap();
        println!("{blank} images without texture: landmarks again {waited} images later");
        assert!(waited <= 6, "{blank} images without texture: landmarks again {waited} images later");
    }
}

#[test]
fn the_exposure_may_double_and_the_noise_may_be_strong() {
    let mut recording = recording();
    for (k, (_, image)) in recording.images.iter_mut().enumerate() {
        let gain = if k >= 80 { 2.0 } else { 1.0 };
        *image = add_noise(&image.map(|&p| (f64::from(p) * gain).min(255.0) as u8), 8.0, 1000 + k as u64);
    }
    let outputs = recording.run();
    assert!(lost(&outputs).is_empty(), "{:?}", lost(&outputs));
    within("exposure doubled, noise of 8 grey levels", &recording, &outputs, 0.1);
}

#[test]
#[ignore = "long form: cargo test --release -p vidar-odometry --test flights ladder -- --ignored"]
fn images_may_be_blurred_by_20_ms_of_exposure() {
    let recording = rendered(7.0, 0.02, 5);
    let outputs = recording.run();
    assert!(lost(&outputs).is_empty(), "{:?}", lost(&outputs));
    within("20 ms of exposure", &recording, &outputs, 0.05);
}
