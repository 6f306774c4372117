//! A stretch of some seconds with its camera positions and points, eliminated onto the parameters of the recording.
//!
//! The gyroscope gives the rotation at the exposure time of every row; positions of the camera at the images' times and
//! points (direction and inverse distance from the stretch's reference position) are free, because the translation of a hand
//! that turns looks like a wrong focal length to any two views: only the structure of the scene tells them apart. Errors of
//! the integrated gyroscope are estimated as a random walk of small rotations. Positions between images are interpolated by
//! a parabola through the three nearest. Points and then images are eliminated by Schur complements.

use super::parameters::{BIAS, Projection};
use super::parameters::{DIM, FOCAL, LENS, OFFSET, Parameters, READOUT, ROTATION, SCALE, Tangent};
use super::path::{GyroPath, PathPoint};
use nalgebra::{DMatrix, DVector, Matrix2x3, Matrix3, SMatrix, Vector2, Vector3};
use vidar_core::camera::Pixel;
use vidar_core::{LieGroup, So3};
use vidar_solve::Kernel;

/// Unknowns of an image: rotation by which the gyroscope's is wrong, position.
const NODE: usize = 6;
/// Columns of one observation: its image's rotation, three positions, the parameters.
const TOUCHED: usize = 3 + 9 + DIM;

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
    pub observations: Vec<NodeObservation>,
}

/// One image of the stretch.
#[derive(Clone, Copy, Debug)]
pub(super) struct Node {
    /// Stamp, s.
    pub secs: f64,
    /// Left rotation that corrects the gyroscope's.
    pub drift: Vector3<f64>,
    /// In the reference image's body axes.
    pub position: Vector3<f64>,
}

/// Standard deviations that whiten.
#[derive(Clone, Copy, Debug)]
pub(super) struct Noise {
    pub pixel: f64,
    /// Gyroscope white noise, rad/s/√Hz.
    pub gyro: f64,
}

/// A stretch.
#[derive(Clone, Debug)]
pub(super) struct Window {
    pub nodes: Vec<Node>,
    pub points: Vec<Point>,
    /// The image whose frame is the stretch's.
    pub reference: usize,
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

/// A residual with its derivatives, whitened.
struct Linear {
    residual: Vector2<f64>,
    columns: [usize; TOUCHED],
    jacobian: SMatrix<f64, 2, TOUCHED>,
    d_point: SMatrix<f64, 2, 3>,
}

/// The geometry of one observation.
struct Seen {
    /// camera_from_reference.
    turn: Matrix3<f64>,
    /// From the camera's position to the point, times the inverse distance, in the reference's axes.
    ray: Vector3<f64>,
    in_camera: Vector3<f64>,
    path: PathPoint,
    position: Vector3<f64>,
    near: [(usize, f64, f64); 3],
}

impl Window {
    /// The robust cost.
    pub fn cost(&self, parameters: &Parameters, path: &GyroPath, noise: &Noise) -> f64 {
        let reference = path.at(self.nodes[self.reference].secs + parameters.offset_secs);
        let mut cost = self.prior_cost(noise);
        for point in &self.points {
            for seen in &point.observations {
                let at = self.see(point, seen, parameters, path, &reference);
                let e2 = parameters
                    .project(&at.in_camera)
                    .map_or(INVALID * INVALID, |p| ((seen.pixel - p.pixel) / noise.pixel).norm_squared());
                cost += KERNEL.loss(e2);
            }
        }
        cost
    }

    /// All residuals in pixels, those that cannot be predicted left out.
    pub fn residuals(&self, parameters: &Parameters, path: &GyroPath) -> Vec<Vector2<f64>> {
        let reference = path.at(self.nodes[self.reference].secs + parameters.offset_secs);
        let all = self.points.iter().flat_map(|p| p.observations.iter().map(move |o| (p, o)));
        all.filter_map(|(point, seen)| {
            let at = self.see(point, seen, parameters, path, &reference);
            Some(seen.pixel - parameters.project(&at.in_camera)?.pixel)
        })
        .collect()
    }

    fn see(
        &self,
        point: &Point,
        seen: &NodeObservation,
        parameters: &Parameters,
        path: &GyroPath,
        reference: &PathPoint,
    ) -> Seen {
        let node = &self.nodes[seen.node];
        let late = seen.row * parameters.readout_secs;
        let at = path.at(node.secs + parameters.offset_secs + late);
        let body_from_camera = parameters.body_from_camera.matrix();
        let reference_from_body =
            So3::exp(&node.drift).matrix() * reference.rotation.transpose() * at.rotation;
        let turn = (reference_from_body * body_from_camera).transpose();
        let near = self.interpolation(seen.node, late);
        let position = near.iter().map(|(k, w, _)| self.nodes[*k].position * *w).sum();
        let ray = point.direction - position * point.inverse_distance;
        Seen { turn, ray, in_camera: turn * ray, path: at, position, near }
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

    /// The walk's standard deviation from a node to the next, rad.
    fn walk_sigma(&self, k: usize, noise: &Noise) -> f64 {
        noise.gyro * (self.nodes[k + 1].secs - self.nodes[k].secs).max(1e-3).sqrt()
    }

    fn prior_cost(&self, noise: &Noise) -> f64 {
        let mut sum = 0.0;
        for (k, node) in self.nodes.iter().enumerate() {
            let sigma = if k == self.reference { FIXED } else { POSITION_PRIOR };
            sum += node.position.norm_squared() / (sigma * sigma);
            if k == self.reference {
                sum += node.drift.norm_squared() / (FIXED * FIXED);
            }
            if let Some(next) = self.nodes.get(k + 1) {
                let sigma = self.walk_sigma(k, noise);
                sum += (next.drift - node.drift).norm_squared() / (sigma * sigma);
            }
        }
        for point in &self.points {
            let off = (point.inverse_distance - 1.0) / INVERSE_DISTANCE_PRIOR;
            sum += off * off;
        }
        0.5 * sum
    }

    /// Linearises and eliminates; `damping` is Levenberg and Marquardt's factor on the diagonal. `None` where a block has no
    /// inverse.
    pub fn reduce(
        &self,
        parameters: &Parameters,
        path: &GyroPath,
        noise: &Noise,
        damping: f64,
    ) -> Option<Reduced> {
        let own = NODE * self.nodes.len();
        let all = own + DIM;
        let mut h = DMatrix::<f64>::zeros(all, all);
        let mut g = DVector::<f64>::zeros(all);
        let reference = path.at(self.nodes[self.reference].secs + parameters.offset_secs);
        self.add_priors(&mut h, &mut g, noise);
        let mut blocks = Vec::with_capacity(self.points.len());
        for point in &self.points {
            let tangents = tangents(&point.direction);
            let weight = 1.0 / (INVERSE_DISTANCE_PRIOR * INVERSE_DISTANCE_PRIOR);
            let mut block = Matrix3::from_diagonal(&Vector3::new(1e-6, 1e-6, weight));
            let mut gradient = Vector3::new(0.0, 0.0, weight * (1.0 - point.inverse_distance));
            let mut coupling = DMatrix::<f64>::zeros(all, 3);
            for seen in &point.observations {
                let at = self.see(point, seen, parameters, path, &reference);
                let Some(projection) = parameters.project(&at.in_camera) else { continue };
                let linear = self.linearise(point, seen, &at, &projection, &reference, &tangents, noise);
                let w = KERNEL.weight(linear.residual.norm_squared());
                let weighted = linear.jacobian * w;
                for (a, &column) in linear.columns.iter().enumerate() {
                    g[column] += weighted.column(a).dot(&linear.residual);
                    for p in 0..3 {
                        coupling[(column, p)] += weighted.column(a).dot(&linear.d_point.column(p));
                    }
                    for (b, &other) in linear.columns.iter().enumerate().skip(a) {
                        let value = weighted.column(a).dot(&linear.jacobian.column(b));
                        h[(column.max(other), column.min(other))] += value;
                    }
                }
                block += linear.d_point.transpose() * linear.d_point * w;
                gradient += linear.d_point.transpose() * linear.residual * w;
            }
            for p in 0..3 {
                block[(p, p)] *= 1.0 + damping;
            }
            let inverse = block.try_inverse()?;
            eliminate(&mut h, &mut g, &coupling, &inverse, &gradient);
            blocks.push(PointBlock { inverse, gradient, coupling, tangents });
        }
        for k in 0..own {
            h[(k, k)] *= 1.0 + damping;
        }
        let nodes = h.view((0, 0), (own, own)).into_owned().cholesky()?;
        let coupling = h.view((own, 0), (DIM, own)).transpose();
        let by_parameters = nodes.solve(&coupling);
        let solved = nodes.solve(&g.rows(0, own));
        let mut hessian = SMatrix::<f64, DIM, DIM>::zeros();
        let mut gradient = Tangent::zeros();
        for a in 0..DIM {
            gradient[a] = g[own + a] - coupling.column(a).dot(&solved);
            for b in 0..DIM {
                hessian[(a, b)] =
                    h[(own + a.max(b), own + a.min(b))] - coupling.column(a).dot(&by_parameters.column(b));
            }
        }
        let back = BackSubstitution { by_parameters, nodes: solved, points: blocks };
        Some(Reduced { hessian, gradient, back })
    }

    fn add_priors(&self, h: &mut DMatrix<f64>, g: &mut DVector<f64>, noise: &Noise) {
        for (k, node) in self.nodes.iter().enumerate() {
            let is_reference = k == self.reference;
            let sigma = if is_reference { FIXED } else { POSITION_PRIOR };
            let weight = 1.0 / (sigma * sigma);
            for a in 0..3 {
                let at = NODE * k + 3 + a;
                h[(at, at)] += weight;
                g[at] -= weight * node.position[a];
                if is_reference {
                    let at = NODE * k + a;
                    h[(at, at)] += 1.0 / (FIXED * FIXED);
                    g[at] -= node.drift[a] / (FIXED * FIXED);
                }
            }
            if let Some(next) = self.nodes.get(k + 1) {
                let sigma = self.walk_sigma(k, noise);
                let weight = 1.0 / (sigma * sigma);
                for a in 0..3 {
                    let (i, j) = (NODE * k + a, NODE * (k + 1) + a);
                    let r = next.drift[a] - node.drift[a];
                    h[(i, i)] += weight;
                    h[(j, j)] += weight;
                    h[(j, i)] -= weight;
                    g[i] += weight * r;
                    g[j] -= weight * r;
                }
            }
        }
    }

    #[allow(clippy::too_many_arguments)] // The inner part of `reduce`, kept apart for its length only.
    fn linearise(
        &self,
        point: &Point,
        seen: &NodeObservation,
        at: &Seen,
        projection: &Projection,
        reference: &PathPoint,
        tangents: &[Vector3<f64>; 2],
        noise: &Noise,
    ) -> Linear {
        let own = NODE * self.nodes.len();
        let by_sigma = 1.0 / noise.pixel;
        let d_camera: Matrix2x3<f64> = projection.d_point * by_sigma;
        let d_ray: Matrix2x3<f64> = d_camera * at.turn;
        // A left rotation φ of the body turns the ray by −φ.
        let d_turn: Matrix2x3<f64> = d_ray * at.ray.cross_matrix();
        let from_first = reference.rotation.transpose();
        let rate = from_first * at.path.rotation * at.path.rate;
        let mut jacobian = SMatrix::<f64, 2, TOUCHED>::zeros();
        let mut columns = [0; TOUCHED];
        for a in 0..3 {
            columns[a] = NODE * seen.node + a;
            for (n, (node, ..)) in at.near.iter().enumerate() {
                columns[3 + 3 * n + a] = NODE * node + 3 + a;
            }
        }
        for p in 0..DIM {
            columns[12 + p] = own + p;
        }
        jacobian.fixed_columns_mut::<3>(0).copy_from(&d_turn);
        let mut velocity = Vector3::zeros();
        for (n, (node, weight, slope)) in at.near.iter().enumerate() {
            let block = d_ray * (-point.inverse_distance * weight);
            jacobian.fixed_columns_mut::<3>(3 + 3 * n).copy_from(&block);
            velocity += self.nodes[*node].position * *slope;
        }
        let first = 12;
        jacobian.fixed_columns_mut::<LENS>(first + FOCAL).copy_from(&(projection.d_lens * by_sigma));
        jacobian.column_mut(first + OFFSET).copy_from(&(d_turn * (rate - reference.rate)));
        jacobian
            .column_mut(first + READOUT)
            .copy_from(&((d_turn * rate - d_ray * velocity * point.inverse_distance) * seen.row));
        jacobian
            .fixed_columns_mut::<3>(first + ROTATION)
            .copy_from(&(d_camera * at.in_camera.cross_matrix()));
        let by_bias = from_first * (reference.bias_integral - at.path.bias_integral);
        jacobian.fixed_columns_mut::<3>(first + BIAS).copy_from(&(d_turn * by_bias));
        let by_scale = from_first * (at.path.scale_integral - reference.scale_integral);
        jacobian.fixed_columns_mut::<3>(first + SCALE).copy_from(&(d_turn * by_scale));
        let mut d_point = SMatrix::<f64, 2, 3>::zeros();
        d_point.column_mut(0).copy_from(&(d_ray * tangents[0]));
        d_point.column_mut(1).copy_from(&(d_ray * tangents[1]));
        d_point.column_mut(2).copy_from(&(d_ray * -at.position));
        Linear { residual: (seen.pixel - projection.pixel) * by_sigma, columns, jacobian, d_point }
    }

    /// Moves nodes and points by what follows from the parameters' step.
    pub fn step(&mut self, reduced: &Reduced, parameters: &Tangent) {
        let back = &reduced.back;
        let own = NODE * self.nodes.len();
        let step = DVector::from_column_slice(parameters.as_slice());
        let nodes = &back.nodes - &back.by_parameters * &step;
        for (k, node) in self.nodes.iter_mut().enumerate() {
            node.drift += nodes.fixed_rows::<3>(NODE * k);
            node.position += nodes.fixed_rows::<3>(NODE * k + 3);
        }
        for (point, block) in self.points.iter_mut().zip(&back.points) {
            let mut right = block.gradient;
            for p in 0..3 {
                let column = block.coupling.column(p);
                right[p] -= column.rows(0, own).dot(&nodes) + column.rows(own, DIM).dot(&step);
            }
            let moved = block.inverse * right;
            let direction = point.direction + block.tangents[0] * moved.x + block.tangents[1] * moved.y;
            point.direction = direction.normalize();
            point.inverse_distance += moved.z;
        }
    }
}

/// Takes a point with block inverse `inverse` and coupling out of `H δ = g` (lower triangle).
fn eliminate(
    h: &mut DMatrix<f64>,
    g: &mut DVector<f64>,
    coupling: &DMatrix<f64>,
    inverse: &Matrix3<f64>,
    gradient: &Vector3<f64>,
) {
    let product = coupling * inverse;
    *g -= &product * gradient;
    let n = h.nrows();
    let (a, b, c) = (coupling.column(0), coupling.column(1), coupling.column(2));
    for column in 0..n {
        let (x, y, z) = (product[(column, 0)], product[(column, 1)], product[(column, 2)]);
        if x == 0.0 && y == 0.0 && z == 0.0 {
            continue;
        }
        let mut target = h.column_mut(column);
        let target = &mut target.as_mut_slice()[column..];
        let (a, b, c) = (&a.as_slice()[column..], &b.as_slice()[column..], &c.as_slice()[column..]);
        for (t, ((a, b), c)) in target.iter_mut().zip(a.iter().zip(b).zip(c)) {
            *t -= a * x + b * y + c * z;
        }
    }
}

/// Two unit vectors across a direction.
fn tangents(direction: &Vector3<f64>) -> [Vector3<f64>; 2] {
    let least = direction.iamin();
    let mut axis = Vector3::zeros();
    axis[least] = 1.0;
    let first = direction.cross(&axis).normalize();
    [first, direction.cross(&first)]
}
