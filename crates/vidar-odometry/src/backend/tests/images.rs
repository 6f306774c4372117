//! Unknowns that every image has of its own: delays where stamps scatter, shifts where images are stabilised.

use crate::backend::*;
use crate::imu::Bias;
use crate::simulate::{
    Course, CourseKind, FeatureOdometry, FeatureOdometryConfig, Simulation, SimulationConfig,
};
use nalgebra::Vector2;
use vidar_core::ImuNoise;

/// What is different about the images of a simulated flight.
#[derive(Clone, Copy, Default)]
struct Images {
    stamp_scatter_secs: f64,
    time_offset_secs: f64,
    /// Amplitude of a stabiliser's shifts, focal lengths.
    shift: f64,
}

impl Images {
    fn settings(&self) -> SimulationConfig {
        let Self { stamp_scatter_secs, time_offset_secs, shift } = *self;
        SimulationConfig { tracks: 60, stamp_scatter_secs, time_offset_secs, shift, ..Default::default() }
    }

    /// Flies for 6 s, calling `look` with every image's number.
    fn fly(self, change: impl Fn(&mut SmootherConfig), mut look: impl FnMut(usize, &mut Smoother)) {
        let course = Course { kind: CourseKind::Eight, secs: 7.0, speed: 1.2, phase: 0.4 };
        let simulation = Simulation::new(&course, 0.0, 6.0, &self.settings());
        let mut config = FeatureOdometryConfig::new(&ImuNoise::EUROC, 2.0);
        config.smoother.estimate_time_offset = true;
        change(&mut config.smoother);
        let mut odometry = FeatureOdometry::for_simulation(config, &simulation).unwrap();
        let first = &simulation.frames[0];
        let sigmas = GaugePriorSigmas { velocity_mps: 0.2, tilt_rad: 0.02, ..GaugePriorSigmas::GAUGE };
        odometry.start_at(first, NavState { bias: Bias::ZERO, ..first.truth }, sigmas).unwrap();
        for (k, frame) in simulation.frames.iter().enumerate().skip(1) {
            odometry.push(frame.id, frame.time, &frame.observations).unwrap();
            look(k, odometry.smoother().unwrap());
        }
    }
}

#[test]
fn scattering_stamps_and_shifted_images_are_told_from_right_ones_and_from_each_other() {
    let log_evidence = |images: Images| {
        let mut sums = [0.0; 2];
        images.fly(
            |_| {},
            |k, smoother| {
                if k % 20 == 0 {
                    let delay = FrameUnknown::Delay { sigma_secs: 2e-3 };
                    let asked = [delay, FrameUnknown::ImageShift { sigma_rad: 2e-3 }];
                    for (sum, unknown) in sums.iter_mut().zip(asked) {
                        *sum += smoother.log_evidence(unknown).unwrap();
                    }
                }
            },
        );
        sums
    };
    for right in [Images::default(), Images { time_offset_secs: 0.01, ..Images::default() }] {
        let found = log_evidence(right);
        assert!(found.iter().all(|l| *l < -20.0), "{found:.1?}");
    }
    let scattering = log_evidence(Images { stamp_scatter_secs: 0.004, ..Images::default() });
    assert!(scattering[0] > 20.0 && scattering[0] > scattering[1] + 20.0, "{scattering:.1?}");
    let shifted = log_evidence(Images { shift: 0.005, ..Images::default() });
    assert!(shifted[1] > 20.0 && shifted[1] > shifted[0] + 20.0, "{shifted:.1?}");
}

#[test]
fn shifts_of_images_are_found() {
    let images = Images { shift: 0.008, ..Images::default() };
    let (mut begin, mut sum, mut count) = (None, 0.0, 0.0);
    images.fly(
        |config| config.image_shift_deg = 0.86,
        |k, smoother| {
            let begin = *begin.get_or_insert(smoother.frames[0].time);
            // A shift that all images share is a turn of the camera on the body: what is known is how they differ. A turn about y moves the picture to
            // the left, one about x down.
            let off = |f: &Frame| {
                let turn = f.image_shift.now;
                Vector2::new(-turn.y, turn.x)
                    - images.settings().lens_at((f.time - begin).as_secs_f64()).shift
            };
            let off: Vec<Vector2<f64>> = smoother.frames.iter().map(off).collect();
            let mean = off.iter().sum::<Vector2<f64>>() / off.len() as f64;
            let rms = (off.iter().map(|o| (o - mean).norm_squared()).sum::<f64>() / off.len() as f64).sqrt();
            if k > 60 {
                (sum, count) = (sum + rms, count + 1.0);
            }
        },
    );
    let mean = sum / count;
    assert!(mean < 0.2 * images.shift, "{mean:.5} of {}", images.shift);
}
