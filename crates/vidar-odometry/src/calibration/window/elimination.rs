//! Linearises a stretch and eliminates its own unknowns: points, then images.

use super::sums::{Linear, NormalEquations};
use super::{
    BackSubstitution, FIXED, INVERSE_DISTANCE_PRIOR, KERNEL, NODE, NodeObservation, Noise, OF_NODES,
    POSITION_PRIOR, Point, PointBlock, Reduced, SHAKES, Seen, TOUCHED, Window, turns::by_turn_and_shift,
};
use crate::calibration::parameters::{BIAS, Projection};
use crate::calibration::parameters::{
    DIM, FOCAL, LENS, OFFSET, Parameters, READOUT, ROTATION, SCALE, Tangent,
};
use crate::calibration::path::{GyroPath, PathPoint};
use nalgebra::{DMatrix, DVector, Matrix2x3, Matrix3, SMatrix, Vector2, Vector3};

impl Window {
    /// Linearises and eliminates; `damping` is Levenberg and Marquardt's factor on the diagonal. `None` where a block has no
    /// inverse.
    pub fn reduce(
        &self,
        parameters: &Parameters,
        path: &GyroPath,
        noise: &Noise,
        damping: f64,
    ) -> Option<Reduced> {
        let own = self.own_unknowns();
        let mut sums = NormalEquations::new(own, self.shakes.is_some());
        let reference = path.at(self.nodes[self.reference].secs + parameters.offset_secs);
        self.add_position_priors(&mut sums.h, &mut sums.g);
        self.add_turns(&mut sums.h, &mut sums.g, &noise.turns);
        let drifts = self.drifts();
        let mut blocks = Vec::with_capacity(self.points.len());
        for point in &self.points {
            let tangents = tangents(&point.direction);
            let weight = 1.0 / (INVERSE_DISTANCE_PRIOR * INVERSE_DISTANCE_PRIOR);
            let mut block = Matrix3::from_diagonal(&Vector3::new(1e-6, 1e-6, weight));
            let mut gradient = Vector3::new(0.0, 0.0, weight * (1.0 - point.inverse_distance));
            let mut coupling = sums.no_coupling();
            for seen in point.observations.iter() {
                let at = self.see(point, seen, parameters, path, &reference, &drifts);
                let Some(projection) = parameters.project(&at.in_camera) else { continue };
                let linear = self.linearise(point, seen, &at, &projection, &reference, &tangents, noise);
                let w = KERNEL.weight(linear.residual.norm_squared());
                sums.add(&linear, w, &mut coupling);
                block += linear.d_point.transpose() * linear.d_point * w;
                gradient += linear.d_point.transpose() * linear.residual * w;
            }
            for p in 0..3 {
                block[(p, p)] *= 1.0 + damping;
            }
            let inverse = block.try_inverse()?;
            sums.eliminate(&coupling, &inverse, &gradient);
            blocks.push(PointBlock { inverse, gradient, coupling, tangents });
        }
        let NormalEquations { mut h, g, .. } = sums;
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

    fn add_position_priors(&self, h: &mut DMatrix<f64>, g: &mut DVector<f64>) {
        for (k, node) in self.nodes.iter().enumerate() {
            let sigma = if k == self.reference { FIXED } else { POSITION_PRIOR };
            let weight = 1.0 / (sigma * sigma);
            for a in 0..3 {
                let at = NODE * k + 3 + a;
                h[(at, at)] += weight;
                g[at] -= weight * node.position[a];
            }
        }
    }

    #[allow(clippy::too_many_arguments)] // The inner part of `reduce`, kept apart for its length only.
    fn linearise(
        &self,
        point: &Point,
        seen: &NodeObservation,
        at: &Seen<'_>,
        projection: &Projection,
        reference: &PathPoint<'_>,
        tangents: &[Vector3<f64>; 2],
        noise: &Noise,
    ) -> Linear {
        let by_sigma = 1.0 / noise.pixel;
        let d_camera: Matrix2x3<f64> = projection.d_point * by_sigma;
        let d_ray: Matrix2x3<f64> = d_camera * at.turn;
        // A left rotation φ of the body turns the ray by −φ.
        let d_turn: Matrix2x3<f64> = d_ray * at.ray.cross_matrix();
        let from_first = at.drift * reference.rotation.transpose();
        let rate = from_first * at.path.rotation * at.path.rate;
        let mut jacobian = SMatrix::<f64, 2, TOUCHED>::zeros();
        let mut columns = [0; OF_NODES];
        for a in 0..3 {
            columns[a] = NODE * seen.node + a;
            for (n, (node, ..)) in at.near.iter().enumerate() {
                columns[3 + 3 * n + a] = NODE * node + 3 + a;
            }
        }
        let (mut d_drift, mut d_taken_back) = (d_turn, Vector2::zeros());
        if let Some(shakes) = &self.shakes {
            let d_shift = Matrix2x3::from_rows(&[-at.turn.row(1), at.turn.row(0).into_owned()]);
            d_drift = by_turn_and_shift(&d_turn, &(d_shift * (at.focal * by_sigma)), &at.turn);
            d_taken_back = d_drift * shakes.taken_back(seen.node, 1.0);
            for (j, rate) in shakes.rates(seen.node).iter().enumerate() {
                jacobian.column_mut(OF_NODES + j).copy_from(&(d_drift * rate * -at.late));
            }
        }
        jacobian.fixed_columns_mut::<3>(0).copy_from(&d_drift);
        let mut velocity = Vector3::zeros();
        for (n, (node, weight, slope)) in at.near.iter().enumerate() {
            let block = d_ray * (-point.inverse_distance * weight);
            jacobian.fixed_columns_mut::<3>(3 + 3 * n).copy_from(&block);
            velocity += self.nodes[*node].position * *slope;
        }
        let first = OF_NODES + SHAKES;
        jacobian.fixed_columns_mut::<LENS>(first + FOCAL).copy_from(&(projection.d_lens * by_sigma));
        let mut d_focal = jacobian.column_mut(first + FOCAL);
        d_focal += at.shift * by_sigma;
        jacobian.column_mut(first + OFFSET).copy_from(&(d_turn * (rate - at.drift * reference.rate)));
        jacobian.column_mut(first + READOUT).copy_from(
            &((d_turn * rate - d_taken_back - d_ray * velocity * point.inverse_distance) * seen.row),
        );
        jacobian
            .fixed_columns_mut::<3>(first + ROTATION)
            .copy_from(&(d_camera * at.in_camera.cross_matrix()));
        let by_bias = from_first * (reference.bias_integral() - at.path.bias_integral());
        jacobian.fixed_columns_mut::<3>(first + BIAS).copy_from(&(d_turn * by_bias));
        let by_scale = from_first * (at.path.scale_integral() - reference.scale_integral());
        jacobian.fixed_columns_mut::<3>(first + SCALE).copy_from(&(d_turn * by_scale));
        let mut d_point = SMatrix::<f64, 2, 3>::zeros();
        d_point.column_mut(0).copy_from(&(d_ray * tangents[0]));
        d_point.column_mut(1).copy_from(&(d_ray * tangents[1]));
        d_point.column_mut(2).copy_from(&(d_ray * -at.position));
        Linear { residual: (seen.pixel - at.shown(projection)) * by_sigma, columns, jacobian, d_point }
    }

    /// Moves nodes and points by what follows from the parameters' step.
    pub fn step(&mut self, reduced: &Reduced, parameters: &Tangent) {
        let back = &reduced.back;
        let own = self.own_unknowns();
        let step = DVector::from_column_slice(parameters.as_slice());
        let nodes = &back.nodes - &back.by_parameters * &step;
        for (k, node) in self.nodes.iter_mut().enumerate() {
            node.drift += nodes.fixed_rows::<3>(NODE * k);
            node.position += nodes.fixed_rows::<3>(NODE * k + 3);
        }
        if let Some(shakes) = &mut self.shakes {
            shakes.shares += nodes.fixed_rows::<SHAKES>(own - SHAKES);
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

/// Two unit vectors across a direction.
fn tangents(direction: &Vector3<f64>) -> [Vector3<f64>; 2] {
    let least = direction.iamin();
    let mut axis = Vector3::zeros();
    axis[least] = 1.0;
    let first = direction.cross(&axis).normalize();
    [first, direction.cross(&first)]
}
