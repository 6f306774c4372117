//! A stretch of some seconds with its camera positions and points, eliminated onto the parameters of the recording.
//!
//! The gyroscope gives the rotation at the exposure time of every row; positions of the camera at the images' times and
//! points (direction and inverse distance from the stretch's reference position) are free, because the translation of a hand
//! that turns looks like a wrong focal length to any two views: only the structure of the scene tells them apart. Errors of
//! the integrated gyroscope are estimated as a random walk of small rotations, or what a stabiliser does as one of each image
//! ([`Turns`]). Positions between images are interpolated by a parabola through the three nearest. Points and then images are
//! eliminated by Schur complements.

mod elimination;
mod sums;
mod turns;

use super::parameters::{DIM, Parameters, Projection, Tangent};
use super::path::{GyroPath, PathPoint};
use nalgebra::{DMatrix, DVector, Matrix3, SMatrix, Vector2, Vector3};
use std::sync::Arc;
use turns::{SHAKES, Shakes, turn_and_shift};
pub(super) use turns::{Turns, rms_per_axis, shift_sigma};
use vidar_core::camera::Pixel;
use vidar_core::{LieGroup, So3};
use vidar_solve::Kernel;

/// Unknowns of an image: rotation by which the gyroscope's is wrong, position.
const NODE: usize = 6;
/// Unknowns of images that an observation depends on: its image's rotation, three positions.
const OF_NODES: usize = 3 + 9;
/// All of them: those, the shares of a stabiliser, the parameters.
const TOUCHED: usize = OF_NODES + SHAKES + DIM;

/// Residuals beyond this many standard deviations lose weight.
const KERNEL: Kernel = Kernel::Cauchy { k: 2.0 };
/// Whitened length that stands for an observation that cannot be predicted.
const INVALID: f64 = 30.0;

/// Standard deviations of the weak priors that fix a stretch's scale: lengths are in units of the usual distance of points.
const POSITION_PRIOR: f64 = 1.0;
const INVERSE_DISTANCE_PRIOR: f64 = 1.0;
/// Of the reference image's rotation and position, which define the stretch's frame.
const FIXED: f64 = 1e-5;

/// Where a point was seen.
#[derive(Clone, Copy, Debug)]
pub(super) struct NodeObservation {
    pub node: usize,
    pub pixel: Pixel,
    /// Row over the image's height, −½…½.
    pub row: f64,
}

/// A point in the reference image's body axes, seen from its position.
#[derive(Clone, Debug)]
pub(super) struct Point {
    pub direction: Vector3<f64>,
    pub inverse_distance: f64,
    /// Shared by the solutions that are tried.
    pub observations: Arc<[NodeObservation]>,
}

/// One image of the stretch.
#[derive(Clone, Copy, Debug)]
pub(super) struct Node {
    /// Stamp, s.
    pub secs: f64,
    /// Left rotation that corrects the gyroscope's; where there is a stabiliser ([`Shakes`]) its part across the view is a shift of the picture.
    pub drift: Vector3<f64>,
    /// In the reference image's body axes.
    pub position: Vector3<f64>,
}

/// Standard deviations that whiten.
#[derive(Clone, Copy, Debug)]
pub(super) struct Noise {
    pub pixel: f64,
    /// Of the images' rotations.
    pub turns: Turns,
}

/// A stretch.
#[derive(Clone, Debug)]
pub(super) struct Window {
    pub nodes: Vec<Node>,
    pub points: Vec<Point>,
    /// The image whose frame is the stretch's.
    pub reference: usize,
    /// What a stabiliser may take back of the turns, where one is looked for.
    pub shakes: Option<Shakes>,
}

/// What is left for the parameters once a stretch's own unknowns are eliminated: `H δ = g`.
pub(super) struct Reduced {
    pub hessian: SMatrix<f64, DIM, DIM>,
    pub gradient: Tangent,
    back: BackSubstitution,
}

struct BackSubstitution {
    /// Inverse of the nodes' block, its product with the coupling to the parameters, and with the gradient.
    by_parameters: DMatrix<f64>,
    nodes: DVector<f64>,
    points: Vec<PointBlock>,
}

struct PointBlock {
    inverse: Matrix3<f64>,
    gradient: Vector3<f64>,
    /// Coupling to nodes and parameters, one row of three per unknown.
    coupling: DMatrix<f64>,
    tangents: [Vector3<f64>; 2],
}

/// The geometry of one observation.
struct Seen<'a> {
    /// camera_from_reference.
    turn: Matrix3<f64>,
    /// From the camera's position to the point, times the inverse distance, in the reference's axes.
    ray: Vector3<f64>,
    in_camera: Vector3<f64>,
    path: PathPoint<'a>,
    /// Rotation by which the gyroscope's is wrong.
    drift: Matrix3<f64>,
    /// Time of its row after its image's, s.
    late: f64,
    focal: f64,
    /// By how much a stabiliser moves the picture, pixels.
    shift: Vector2<f64>,
    position: Vector3<f64>,
    near: [(usize, f64, f64); 3],
}

impl Seen<'_> {
    /// Where it shows in the picture.
    fn shown(&self, projection: &Projection) -> Pixel {
        projection.pixel + self.shift
    }
}

impl Window {
    /// The robust cost.
    pub fn cost(&self, parameters: &Parameters, path: &GyroPath, noise: &Noise) -> f64 {
        let reference = path.at(self.nodes[self.reference].secs + parameters.offset_secs);
        let drifts = self.drifts();
        let mut cost = self.prior_cost(noise);
        for point in &self.points {
            for seen in point.observations.iter() {
                let at = self.see(point, seen, parameters, path, &reference, &drifts);
                let e2 = parameters.project(&at.in_camera).map_or(INVALID * INVALID, |p| {
                    ((seen.pixel - at.shown(&p)) / noise.pixel).norm_squared()
                });
                cost += KERNEL.loss(e2);
            }
        }
        cost
    }

    /// All residuals in pixels, those that cannot be predicted left out.
    pub fn residuals(&self, parameters: &Parameters, path: &GyroPath) -> Vec<Vector2<f64>> {
        let reference = path.at(self.nodes[self.reference].secs + parameters.offset_secs);
        let drifts = self.drifts();
        let all = self.points.iter().flat_map(|p| p.observations.iter().map(move |o| (p, o)));
        all.filter_map(|(point, seen)| {
            let at = self.see(point, seen, parameters, path, &reference, &drifts);
            Some(seen.pixel - at.shown(&parameters.project(&at.in_camera)?))
        })
        .collect()
    }

    /// Rotations of the nodes' drifts; none where a stabiliser is looked for, whose rows have turns of their own.
    fn drifts(&self) -> Vec<Matrix3<f64>> {
        let nodes = if self.shakes.is_some() { &[] } else { &self.nodes[..] };
        nodes.iter().map(|node| So3::exp(&node.drift).matrix()).collect()
    }

    fn see<'a>(
        &self,
        point: &Point,
        seen: &NodeObservation,
        parameters: &Parameters,
        path: &'a GyroPath,
        reference: &PathPoint<'_>,
        drifts: &[Matrix3<f64>],
    ) -> Seen<'a> {
        let node = &self.nodes[seen.node];
        let late = seen.row * parameters.readout_secs;
        let at = path.at(node.secs + parameters.offset_secs + late);
        let body_from_camera = parameters.body_from_camera.matrix();
        let reference_from_camera = reference.rotation.transpose() * at.rotation * body_from_camera;
        let (drift, shifts) = match &self.shakes {
            Some(shakes) => {
                let drift = node.drift - shakes.taken_back(seen.node, late);
                let [turns, shifts] = turn_and_shift(&drift, &reference_from_camera);
                (So3::exp(&turns).matrix(), shifts)
            }
            None => (drifts[seen.node], Vector3::zeros()),
        };
        let turn = (drift * reference_from_camera).transpose();
        // Turned about the camera's x a camera would see things move down, about its y to the left.
        let moved = turn * shifts;
        let (focal, shift) = (parameters.focal, Vector2::new(-moved.y, moved.x) * parameters.focal);
        let near = self.interpolation(seen.node, late);
        let position = near.iter().map(|(k, w, _)| self.nodes[*k].position * *w).sum();
        let ray = point.direction - position * point.inverse_distance;
        Seen { turn, ray, in_camera: turn * ray, path: at, drift, late, focal, shift, position, near }
    }

    /// Nodes, weights and their derivatives by time of the position `late` after a node: Lagrange's parabola.
    fn interpolation(&self, node: usize, late: f64) -> [(usize, f64, f64); 3] {
        let middle = node.clamp(1, self.nodes.len() - 2);
        let at = [middle - 1, middle, middle + 1];
        let t = self.nodes[node].secs + late;
        let [a, b, c] = at.map(|k| self.nodes[k].secs);
        let weight = |p: f64, q: f64, own: f64| {
            let scale = (own - p) * (own - q);
            ((t - p) * (t - q) / scale, (2.0 * t - p - q) / scale)
        };
        let [wa, wb, wc] = [weight(b, c, a), weight(a, c, b), weight(a, b, c)];
        [(at[0], wa.0, wa.1), (at[1], wb.0, wb.1), (at[2], wc.0, wc.1)]
    }

    /// Unknowns of the stretch itself, which are eliminated: of its images, and the shares of a stabiliser.
    fn own_unknowns(&self) -> usize {
        NODE * self.nodes.len() + if self.shakes.is_some() { SHAKES } else { 0 }
    }

    fn prior_cost(&self, noise: &Noise) -> f64 {
        let mut sum = 0.0;
        for (k, node) in self.nodes.iter().enumerate() {
            let sigma = if k == self.reference { FIXED } else { POSITION_PRIOR };
            sum += node.position.norm_squared() / (sigma * sigma);
        }
        for point in &self.points {
            let off = (point.inverse_distance - 1.0) / INVERSE_DISTANCE_PRIOR;
            sum += off * off;
        }
        0.5 * (sum + self.turns_chi2(&noise.turns))
    }
}
