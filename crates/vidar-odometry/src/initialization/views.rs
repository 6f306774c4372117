//! The frames and tracks that an attempt to start is solved from.

use super::linear::{LinearView, Rays};
use super::log::{LoggedFrame, TrackObservation, joined};
use crate::imu::{Bias, Preintegration};
use nalgebra::{Matrix3, Vector3};
use rustc_hash::FxHashMap;
use vidar_core::{CameraModel, LandmarkId, LieGroup, Se3, So3};
use vidar_solve::statistics::median_upper;

/// A chosen frame, with IMU measurements from the chosen one before.
pub(super) struct View<'a> {
    pub logged: &'a LoggedFrame,
    pub preintegration: Option<Preintegration>,
}

/// A track over the chosen frames.
pub(super) struct Track {
    pub landmark: LandmarkId,
    /// View, what it saw, unit ray in its camera.
    pub observations: Vec<(usize, TrackObservation, Vector3<f64>)>,
}

/// Chooses at most `most` frames over the last `window_secs` of the log and joins their IMU measurements.
pub(super) fn choose(log: &[LoggedFrame], window_secs: f64, most: usize) -> Vec<View<'_>> {
    let Some(newest) = log.last() else { return Vec::new() };
    // A frame without IMU measurements cannot be connected to what came before it.
    let chained = log.iter().rposition(|f| f.preintegration.is_none()).unwrap_or(0);
    let within = |f: &&LoggedFrame| (newest.time - f.time).as_secs_f64() <= window_secs + 1e-6;
    let log = &log[chained..];
    let log = &log[log.len() - log.iter().rev().take_while(within).count()..];
    // Frames on a grid that only ever doubles, so that successive attempts choose the same ones; and the newest.
    let mut stride = 1;
    while log.len().saturating_sub(1) / stride + 2 > most {
        stride *= 2;
    }
    let mut chosen: Vec<usize> =
        (0..log.len()).filter(|&k| log[k].frame.index().is_multiple_of(stride)).collect();
    if chosen.last() != Some(&(log.len() - 1)) {
        chosen.push(log.len() - 1);
    }
    let first = chosen.first().map(|&at| View { logged: &log[at], preintegration: None });
    let later = chosen
        .windows(2)
        .map(|pair| View { logged: &log[pair[1]], preintegration: joined(&log[pair[0] + 1..=pair[1]]) });
    first.into_iter().chain(later).collect()
}

/// Tracks that at least three views share, in the order of their names.
pub(super) fn gather(views: &[View<'_>], camera: &CameraModel) -> Vec<Track> {
    let mut at: FxHashMap<LandmarkId, usize> = FxHashMap::default();
    let mut tracks: Vec<Track> = Vec::new();
    for (k, view) in views.iter().enumerate() {
        for observation in &view.logged.observations {
            let Some(ray) = camera.unproject(&observation.pixel) else { continue };
            let slot = *at.entry(observation.landmark).or_insert_with(|| {
                tracks.push(Track { landmark: observation.landmark, observations: Vec::new() });
                tracks.len() - 1
            });
            tracks[slot].observations.push((k, *observation, ray));
        }
    }
    tracks.retain(|t| t.observations.len() >= 3);
    tracks.sort_unstable_by_key(|t| t.landmark);
    tracks
}

/// Rotations first_from_body of all views.
pub(super) fn rotations(views: &[View<'_>], bias: &Bias) -> Vec<So3> {
    let mut turn = So3::IDENTITY;
    let step = |v: &View<'_>| v.preintegration.as_ref().map_or(So3::IDENTITY, |r| r.rotation(bias));
    let next = |v: &View<'_>| {
        turn = turn * step(v);
        turn
    };
    views.iter().map(next).collect()
}

/// Medians over tracks of the widest angle between rays that rotation leaves, and of the turn between the same views, degrees.
pub(super) fn median_parallax_deg(tracks: &[Track], turns: &[So3], body_from_camera: &So3) -> (f64, f64) {
    let (mut widest, mut turned) = (Vec::with_capacity(tracks.len()), Vec::with_capacity(tracks.len()));
    for track in tracks {
        let ray = |s: &(usize, TrackObservation, Vector3<f64>)| turns[s.0] * (*body_from_camera * s.2);
        let (first, first_view) = (ray(&track.observations[0]), track.observations[0].0);
        let apart = track.observations.iter().map(|s| {
            let ray = ray(s);
            (first.cross(&ray).norm().atan2(first.dot(&ray)), s.0)
        });
        let (parallax, view) = apart.fold((0.0, first_view), |a, b| if b.0 > a.0 { b } else { a });
        widest.push(parallax);
        turned.push((turns[first_view].inverse() * turns[view]).log().norm());
    }
    let median = |values: &mut Vec<f64>| median_upper(values).map_or(0.0, f64::to_degrees);
    (median(&mut widest), median(&mut turned))
}

/// Views and rays of the linear system, all turned to the first view.
pub(super) fn linear_input(
    views: &[View<'_>],
    tracks: &[Track],
    turns: &[So3],
    body_from_camera: &Se3,
) -> (Vec<LinearView>, Vec<Rays>) {
    let (mut secs, mut position, mut velocity) = (0.0, Vector3::zeros(), Vector3::zeros());
    let (mut position_by, mut velocity_by) = (Matrix3::zeros(), Matrix3::zeros());
    let mut before = So3::IDENTITY;
    let mut linear_views = Vec::with_capacity(views.len());
    for (view, turn) in views.iter().zip(turns) {
        if let Some(r) = &view.preintegration {
            let (_, dp, dv) = r.corrected(r.bias());
            let t = r.secs();
            let m = before.matrix();
            position += velocity * t + before * dp;
            position_by += velocity_by * t + m * r.delta.by_accel_bias.fixed_view::<3, 3>(3, 0);
            velocity += before * dv;
            velocity_by += m * r.delta.by_accel_bias.fixed_view::<3, 3>(6, 0);
            secs += t;
        }
        before = *turn;
        let offset = position + *turn * body_from_camera.translation;
        linear_views.push(LinearView { secs, offset, by_accel_bias: position_by });
    }
    let camera = body_from_camera.rotation;
    let rays =
        |t: &Track| t.observations.iter().map(|(k, _, ray)| (*k, turns[*k] * (camera * *ray))).collect();
    (linear_views, tracks.iter().map(rays).collect())
}

/// Mean standard deviation of the rays' directions, rad.
pub(super) fn ray_sigma_rad(tracks: &[Track], camera: &CameraModel) -> f64 {
    let variances = tracks.iter().flat_map(|t| &t.observations).map(|(_, s, _)| 0.5 * s.covariance.trace());
    let (sum, count) = variances.fold((0.0, 0.0), |(sum, count), v| (sum + v, count + 1.0));
    let mean = if count > 0.0 { sum / count } else { 1.0 };
    let focal = 0.5 * (camera.intrinsics().fx + camera.intrinsics().fy);
    (mean.sqrt() / focal).max(1e-5)
}
