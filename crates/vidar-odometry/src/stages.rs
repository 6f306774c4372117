//! Where the time of an image goes.

use std::time::{Duration, Instant};

/// A stage of the work on one image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// The image at several resolutions, and the IMU measurements up to it.
    Pyramid,
    /// The search for a first metric state.
    Initialise,
    /// The state's prediction by IMU measurements or, without an IMU, by image alignment.
    Predict,
    /// Landmarks and seeds measured against their keyframes' patches.
    Match,
    /// The window's states and landmarks, and which observations do not fit.
    Smooth,
    /// Distances of seeds.
    Distances,
    /// A new keyframe: detection of features.
    Keyframe,
    /// Frames that leave the window.
    Marginalise,
    /// Covariances, health, keyframes and revised poses of the output.
    Output,
}

impl Stage {
    /// All stages, in the order in which an image passes them.
    pub const ALL: [Self; 9] = [
        Self::Pyramid,
        Self::Initialise,
        Self::Predict,
        Self::Match,
        Self::Smooth,
        Self::Distances,
        Self::Keyframe,
        Self::Marginalise,
        Self::Output,
    ];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Pyramid => "pyramid",
            Self::Initialise => "initialise",
            Self::Predict => "predict",
            Self::Match => "match",
            Self::Smooth => "smooth",
            Self::Distances => "distances",
            Self::Keyframe => "keyframe",
            Self::Marginalise => "marginalise",
            Self::Output => "output",
        }
    }
}

/// Wall time that one image took, by stage.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StageTimes([Duration; Stage::ALL.len()]);

impl StageTimes {
    /// Time of one stage; zero when the image did not pass it.
    pub fn of(&self, stage: Stage) -> Duration {
        self.0[stage as usize]
    }

    /// Time of all stages.
    pub fn total(&self) -> Duration {
        self.0.iter().sum()
    }
}

/// Gives the time since the last lap to a stage.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StageClock {
    last: Instant,
    times: StageTimes,
}

impl StageClock {
    pub fn start() -> Self {
        Self { last: Instant::now(), times: StageTimes::default() }
    }

    pub fn lap(&mut self, stage: Stage) {
        let now = Instant::now();
        self.times.0[stage as usize] += now - self.last;
        self.last = now;
    }

    pub fn times(&self) -> StageTimes {
        self.times
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn laps_add_up_to_the_whole() {
        let mut clock = StageClock::start();
        let begin = clock.last;
        for stage in [Stage::Pyramid, Stage::Match, Stage::Smooth, Stage::Match] {
            clock.lap(stage);
        }
        let times = clock.times();
        assert_eq!(times.total(), clock.last - begin);
        assert_eq!(times.of(Stage::Initialise), Duration::ZERO);
        assert!(Stage::ALL.iter().enumerate().all(|(k, s)| *s as usize == k));
    }
}
