//! Which lens and which mount explain the tracks of a recording.

use super::hand_eye::{self, Start};
use super::lens::LensModel;
use super::parameters::{FOCAL, GivenLens, Parameters};
use super::path::GyroPath;
use super::solve::{Problem, Solution};
use super::window::{Turns, Window};
use super::{CalibrationFailure, START_READOUT_SECS};
use crate::gyro_alignment::{ImageFeatures, RateSample};
use nalgebra::Vector3;
use std::f64::consts::{FRAC_PI_2, PI};
use vidar_core::{LieGroup, So3};

/// A radial-tangential lens as wide as this (focal length in image widths; 78°) may be a fisheye, and one that leaves more than
/// this much of the tracks, px, may be anything else.
const WIDE_FOCAL: f64 = 0.62;
pub(super) const DOUBTFUL_PX: f64 = 0.4;
/// By how much another lens or mount has to explain the tracks better, log likelihood per observation: what is left is not white, and a mount that
/// nothing tells from the right one was better by 0.005 (simulated). On a GoPro's walk the wrong ones are worse by 3.
const MARGIN: f64 = 0.02;

/// How far an assumed mount may be off, rad (σ): cameras stand in phones within a degree or two.
const MOUNT_SIGMA: f64 = 0.05;
/// Nearer to a given focal length than this many of its standard deviations it does not matter what each of both is worth.
const NEAR_ITS_LENS: f64 = 0.5;
/// A given mount is not the recording's where it would be turned by more than this many standard deviations.
const MOST_TURN: f64 = 3.0;
/// Mounts that are refined: the assumed one and those whose rates fit best. Turning about one axis leaves at least two that differ by half a turn
/// about it.
const REFINED_MOUNTS: usize = 3;
/// Starts of an assumed mount that are refined.
const STARTS_OF_A_MOUNT: usize = 3;

/// By how much a stabiliser may have shortened the focal length: a picture that moves half as far as the camera turns looks like half of it.
const SHORTENED: [f64; 3] = [1.0, 1.25, 1.6];
/// Focal length of a usual camera, image widths.
const USUAL_FOCAL: f64 = 0.75;

/// What was seen and felt, in seconds after the first image.
pub(super) struct Tracks<'a> {
    pub size: (f64, f64),
    pub images: &'a [ImageFeatures],
    pub samples: &'a [RateSample],
    pub as_measured: &'a GyroPath,
    pub gyro_noise: f64,
    pub windows: &'a [Window],
    /// The lens, where it is given.
    pub lens: Option<GivenLens>,
}

/// A problem and its solution.
pub(super) type Solved<'a> = (Problem<'a>, Solution);

impl<'a> Tracks<'a> {
    /// The given lens; else a radial-tangential one, or a fisheye where that one is wide or explains little and a fisheye explains more.
    pub fn explained_by_a_lens(&self, mount: Option<&So3>) -> Result<Solved<'a>, CalibrationFailure> {
        if let Some(given) = &self.lens {
            let (problem, solution) = self.explained_by(given.camera.lens, mount)?;
            if given.off(solution.parameters.focal) < NEAR_ITS_LENS {
                return Ok((problem, solution));
            }
            // What is given weighs as much against what the stretches say as that is worth.
            let weight = problem.understatement(&solution, FOCAL).ok_or(CalibrationFailure::Unexplained)?;
            let lens = Some(GivenLens { weight, ..*given });
            let again = Tracks { lens, ..*self }.solved(&[solution.parameters], mount);
            return again.ok_or(CalibrationFailure::Unexplained);
        }
        let narrow = self.explained_by(LensModel::RadTan, mount);
        let is_narrow =
            |s: &Solution| s.parameters.focal > WIDE_FOCAL * self.size.0 && s.noise.pixel < DOUBTFUL_PX;
        if narrow.as_ref().is_ok_and(|(_, solution)| is_narrow(solution)) {
            return narrow;
        }
        let Ok((problem, wide)) = self.explained_by(LensModel::Equidistant, mount) else { return narrow };
        // What explains the tracks as a fisheye is a start for the other lens, which may have missed it.
        let start = Parameters { lens: LensModel::RadTan, k1: 0.0, k2: 0.0, ..wide.parameters };
        let narrow = [narrow.ok(), self.solved(&[start], mount)].into_iter().flatten();
        match narrow.min_by(|a, b| a.1.score().total_cmp(&b.1.score())) {
            Some(narrow) if wide.score() > narrow.1.score() - self.margin() => Ok(narrow),
            _ => Ok((problem, wide)),
        }
    }

    /// A lens on a camera that is mounted as `given`, where that explains the tracks.
    pub fn explained_by_a_given_mount(&self, given: &So3) -> Option<Solved<'a>> {
        let (problem, solution) = self.explained_by_a_lens(Some(given)).ok()?;
        let turn = (given.inverse() * solution.parameters.body_from_camera).angle_rad();
        let is_explained = solution.noise.pixel < DOUBTFUL_PX && turn < MOST_TURN * MOUNT_SIGMA;
        is_explained.then_some((problem, solution))
    }

    /// Any lens on a camera that is mounted as `assumed`, turned about its view by quarter turns, or looks the other way. What turning about one
    /// axis does not tell apart is taken as assumed, or refused where it is none of these.
    pub fn explained_by_a_mount(&self, assumed: &So3) -> Result<Solved<'a>, CalibrationFailure> {
        let about = |axis: Vector3<f64>, angle: f64| So3::from_axis_angle(&axis, angle);
        let sides = [0.0, PI].map(|angle| *assumed * about(Vector3::y(), angle));
        let quarters = |side: So3| (0..4).map(move |k| side * about(Vector3::z(), f64::from(k) * FRAC_PI_2));
        let mut mounts: Vec<(f64, bool, So3)> = Vec::new();
        for mount in sides.into_iter().flat_map(quarters) {
            let starts =
                [LensModel::RadTan, LensModel::Equidistant].map(|lens| self.starts(lens, Some(&mount)));
            let best = starts.iter().filter_map(|starts| starts.first()).map(|s| s.unexplained);
            mounts.extend(best.reduce(f64::min).map(|left| (left, mounts.is_empty(), mount)));
        }
        // The assumed one first.
        mounts.sort_by(|a, b| b.1.cmp(&a.1).then(a.0.total_cmp(&b.0)));
        let refined = mounts.iter().take(REFINED_MOUNTS).filter_map(|(_, is_assumed, mount)| {
            let solved = self.explained_by_a_lens(Some(mount)).ok()?;
            let handicap = if *is_assumed { 0.0 } else { self.margin() };
            Some((solved.1.score() + handicap, *is_assumed, solved))
        });
        let mut refined: Vec<(f64, bool, Solved<'a>)> = refined.collect();
        refined.sort_by(|a, b| b.0.total_cmp(&a.0));
        let Some((score, is_assumed, best)) = refined.pop() else {
            return Err(CalibrationFailure::TooLittleRotation);
        };
        let is_alone = refined.last().is_none_or(|second| second.0 - score > self.margin());
        let is_told = (is_assumed || is_alone) && best.1.noise.pixel < DOUBTFUL_PX;
        if is_told { Ok(best) } else { Err(CalibrationFailure::TooLittleRotation) }
    }

    /// A camera with a stabiliser, where one explains the tracks better than what was `found` without.
    pub fn explained_by_a_stabiliser(&self, (problem, found): &Solved<'a>) -> Option<Solved<'a>> {
        let problem = Problem { turns: Turns::STABILISED, ..*problem };
        let lenses =
            SHORTENED.map(|times| Parameters { focal: times * found.parameters.focal, ..found.parameters });
        let solution = problem.solve(&lenses, self.windows)?;
        (solution.score() < found.score() - self.margin()).then_some((problem, solution))
    }

    fn margin(&self) -> f64 {
        let points = self.windows.iter().flat_map(|w| &w.points);
        MARGIN * points.map(|p| p.observations.len()).sum::<usize>() as f64
    }

    fn starts(&self, lens: LensModel, mount: Option<&So3>) -> Vec<Start> {
        let mut trials = match self.lens {
            Some(given) if given.is_measured => Vec::new(),
            _ => Parameters::trials(lens, self.size, START_READOUT_SECS),
        };
        trials.extend(self.lens.map(|given| given.camera));
        hand_eye::starts(&trials, mount, self.images, self.as_measured)
    }

    fn explained_by(&self, lens: LensModel, mount: Option<&So3>) -> Result<Solved<'a>, CalibrationFailure> {
        let mut starts = self.starts(lens, mount);
        // With the mount, rates tell clock and focal length well enough.
        starts.truncate(if mount.is_some() { STARTS_OF_A_MOUNT } else { starts.len() });
        let starts: Vec<Parameters> = starts.iter().map(|s| s.parameters).collect();
        if starts.is_empty() {
            return Err(CalibrationFailure::TooLittleRotation);
        }
        self.solved(&starts, mount).ok_or(CalibrationFailure::Unexplained)
    }

    fn solved(&self, starts: &[Parameters], mount: Option<&So3>) -> Option<Solved<'a>> {
        let first = starts.first()?;
        let usual =
            || Parameters::plain(first.lens, USUAL_FOCAL * self.size.0, self.size, START_READOUT_SECS);
        let prior = Parameters {
            body_from_camera: mount.copied().unwrap_or(first.body_from_camera),
            ..self.lens.map_or_else(usual, |given| given.camera)
        };
        let problem = Problem {
            samples: self.samples,
            width: self.size.0,
            prior,
            lens: self.lens,
            mount_sigma: mount.map(|_| MOUNT_SIGMA),
            turns: Turns::Gyroscope(self.gyro_noise),
            margin: self.margin(),
        };
        let solution = problem.solve(starts, self.windows)?;
        Some((problem, solution))
    }
}
