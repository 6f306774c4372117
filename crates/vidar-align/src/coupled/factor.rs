//! What is known, as residuals with Jacobians.

use nalgebra::{DMatrix, Matrix3, Matrix6, SMatrix, SVector, UnitVector3, Vector3};
use vidar_core::{LieGroup, Se3, Sim3, So3};
use vidar_solve::Kernel;

/// One measurement. Standard deviations must be finite and positive.
#[derive(Clone, Debug)]
pub enum Factor {
    /// Odometry between keyframes: `r = W Log(Z⁻¹ Tᵢ⁻¹ Tⱼ)`.
    Odometry {
        /// The earlier keyframe.
        i: usize,
        /// The later keyframe.
        j: usize,
        /// Measured `camera_i_from_camera_j`.
        i_from_j: Se3,
        /// W, with `Wᵀ W` the information matrix; tangent order.
        whitening: Box<Matrix6<f64>>,
    },
    /// Direction of gravity from the odometry's accelerometer: `r = (Rᵢᵀ e_z − g) / σ`.
    Gravity {
        /// Which keyframe.
        i: usize,
        /// The world's up in the camera.
        up_in_camera: UnitVector3<f64>,
        /// Standard deviation, rad.
        std_rad: f64,
    },
    /// A camera as its chunk sees it.
    Attachment(Attachment),
    /// Two chunks tied by what both see.
    Relative(RelativeChunk),
    /// The scale of a chunk from landmarks whose metric depth is known: `r = (σₖ − z) / s`.
    Scale {
        /// Which chunk.
        k: usize,
        /// Measured ln(metres per chunk unit).
        log_scale: f64,
        /// Standard deviation of it.
        std: f64,
        /// Landmarks may be grossly wrong.
        kernel: Kernel,
    },
    /// Where neither landmarks nor motion tell a chunk's scale, it stays near its neighbour's:
    /// `r = (σₖ − σₗ − ln s) / std`.
    ScaleWalk {
        /// Which chunk.
        k: usize,
        /// Its neighbour.
        l: usize,
        /// Measured `ln(scale of k / scale of l)`, from their overlap.
        log_ratio: f64,
        /// Standard deviation of the walk.
        std: f64,
    },
    /// Fixes what nothing can measure: position and heading of one keyframe.
    GaugePrior {
        /// Which keyframe.
        i: usize,
        /// Where it is.
        world_from_camera: Se3,
        /// Standard deviation of position, m.
        position_std_m: f64,
        /// Standard deviation of heading, rad.
        heading_std_rad: f64,
    },
}

/// `r = [Log(Rᵢᵀ Rₖ R_c) / σ_R ; Rᵢᵀ (Xₖ p_c − pᵢ) / σ_p]`.
#[derive(Clone, Copy, Debug)]
pub struct Attachment {
    /// Which keyframe.
    pub i: usize,
    /// Which chunk.
    pub k: usize,
    /// The model's pose of the camera, chunk units.
    pub chunk_from_camera: Se3,
    /// Standard deviation of the rotation, rad, inflated.
    pub rotation_std_rad: f64,
    /// Standard deviation of the centre, m, inflated.
    pub position_std_m: f64,
    /// Poses of a model may be grossly wrong.
    pub kernel: Kernel,
    /// Whether the keyframe is moved by it. In a pose-conditioned chunk the model mostly repeats the poses that it was
    /// given: they determine the chunk's place and are no new measurement of the keyframe.
    pub moves_keyframe: bool,
}

/// `r = W Log(Z⁻¹ Xₗ⁻¹ Xₖ)`, in the units of chunk k, so that no chunk grows small to please it.
#[derive(Clone, Debug)]
pub struct RelativeChunk {
    /// The chunk that is mapped.
    pub k: usize,
    /// The chunk it is mapped to.
    pub l: usize,
    /// Measured `chunk_l_from_chunk_k`.
    pub l_from_k: Sim3,
    /// W, with `Wᵀ W` the information of δ in `l_from_k · exp(δ)`; tangent order.
    pub whitening: Box<SMatrix<f64, 7, 7>>,
    /// Overlaps and above all loops may be false.
    pub kernel: Kernel,
}

impl RelativeChunk {
    /// From the covariance of δ; `None` when it is not positive definite.
    pub fn from_covariance(
        k: usize,
        l: usize,
        l_from_k: Sim3,
        covariance: &SMatrix<f64, 7, 7>,
        kernel: Kernel,
    ) -> Option<Self> {
        let symmetric = (covariance + covariance.transpose()) * 0.5;
        let information = symmetric.cholesky()?.inverse();
        let whitening = ((information + information.transpose()) * 0.5).cholesky()?.l().transpose();
        Some(Self { k, l, l_from_k, whitening: Box::new(whitening), kernel })
    }
}

/// Which unknown a block belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Variable {
    Keyframe(usize),
    Chunk(usize),
}

/// A whitened residual with its Jacobians by right perturbations.
pub(super) struct Linearised {
    pub residual: Vec<f64>,
    pub jacobians: Vec<(Variable, DMatrix<f64>)>,
}

impl Factor {
    /// Its robust kernel.
    pub fn kernel(&self) -> Kernel {
        match self {
            Self::Attachment(a) => a.kernel,
            Self::Relative(r) => r.kernel,
            Self::Scale { kernel, .. } => *kernel,
            _ => Kernel::Quadratic,
        }
    }

    /// Unknowns it touches.
    pub(super) fn variables(&self) -> Vec<Variable> {
        use Variable::{Chunk, Keyframe};
        match self {
            Self::Odometry { i, j, .. } => vec![Keyframe(*i), Keyframe(*j)],
            Self::Gravity { i, .. } | Self::GaugePrior { i, .. } => vec![Keyframe(*i)],
            Self::Attachment(a) => vec![Keyframe(a.i), Chunk(a.k)],
            Self::Relative(r) => vec![Chunk(r.k), Chunk(r.l)],
            Self::Scale { k, .. } => vec![Chunk(*k)],
            Self::ScaleWalk { k, l, .. } => vec![Chunk(*k), Chunk(*l)],
        }
    }

    pub(super) fn linearise(&self, keyframes: &[Se3], chunks: &[Sim3]) -> Option<Linearised> {
        match self {
            Self::Odometry { i, j, i_from_j, whitening } => {
                odometry(*i, *j, &keyframes[*i], &keyframes[*j], i_from_j, whitening)
            }
            Self::Gravity { i, up_in_camera, std_rad } => {
                Some(gravity(*i, &keyframes[*i], up_in_camera, *std_rad))
            }
            Self::Attachment(a) => attachment(a, &keyframes[a.i], &chunks[a.k]),
            Self::Relative(r) => relative(r, &chunks[r.k], &chunks[r.l]),
            Self::Scale { k, log_scale, std, .. } => {
                let jacobian = scale_row(1.0 / std);
                let residual = vec![(chunks[*k].scale.ln() - log_scale) / std];
                Some(Linearised { residual, jacobians: vec![(Variable::Chunk(*k), jacobian)] })
            }
            Self::ScaleWalk { k, l, log_ratio, std } => {
                let residual = vec![((chunks[*k].scale / chunks[*l].scale).ln() - log_ratio) / std];
                let (k, l) = (Variable::Chunk(*k), Variable::Chunk(*l));
                Some(Linearised {
                    residual,
                    jacobians: vec![(k, scale_row(1.0 / std)), (l, scale_row(-1.0 / std))],
                })
            }
            Self::GaugePrior { i, world_from_camera, position_std_m, heading_std_rad } => {
                gauge_prior(*i, &keyframes[*i], world_from_camera, *position_std_m, *heading_std_rad)
            }
        }
    }
}

fn dynamic<const R: usize, const C: usize>(matrix: SMatrix<f64, R, C>) -> DMatrix<f64> {
    DMatrix::from_column_slice(R, C, matrix.as_slice())
}

fn scale_row(value: f64) -> DMatrix<f64> {
    let mut row = DMatrix::zeros(1, 7);
    row[6] = value;
    row
}

fn odometry(
    i: usize,
    j: usize,
    world_from_i: &Se3,
    world_from_j: &Se3,
    i_from_j: &Se3,
    whitening: &Matrix6<f64>,
) -> Option<Linearised> {
    let predicted = world_from_i.inverse() * *world_from_j;
    let r = (i_from_j.inverse() * predicted).log();
    let d_r = Se3::right_jacobian_inverse(&r)?;
    let d_i = -d_r * predicted.inverse().adjoint();
    Some(Linearised {
        residual: (whitening * r).as_slice().to_vec(),
        jacobians: vec![
            (Variable::Keyframe(i), dynamic(whitening * d_i)),
            (Variable::Keyframe(j), dynamic(whitening * d_r)),
        ],
    })
}

fn gravity(i: usize, world_from_i: &Se3, up_in_camera: &UnitVector3<f64>, std_rad: f64) -> Linearised {
    let up = world_from_i.rotation.inverse().act(&Vector3::z());
    let mut jacobian = DMatrix::zeros(3, 6);
    jacobian.view_mut((0, 0), (3, 3)).copy_from(&(up.cross_matrix() / std_rad));
    let residual = (up - up_in_camera.into_inner()) / std_rad;
    Linearised { residual: residual.as_slice().to_vec(), jacobians: vec![(Variable::Keyframe(i), jacobian)] }
}

fn attachment(a: &Attachment, world_from_i: &Se3, world_from_k: &Sim3) -> Option<Linearised> {
    let (c, i_from_world) = (&a.chunk_from_camera, world_from_i.rotation.inverse());
    let turned: So3 = i_from_world * world_from_k.rotation * c.rotation;
    let phi = turned.log();
    let d_phi = So3::right_jacobian_inverse(&phi)?;
    let offset = i_from_world.act(&(world_from_k.act(&c.translation) - world_from_i.translation));
    let (wr, wp) = (1.0 / a.rotation_std_rad, 1.0 / a.position_std_m);
    let mut residual = SVector::<f64, 6>::zeros();
    residual.fixed_rows_mut::<3>(0).copy_from(&(phi * wr));
    residual.fixed_rows_mut::<3>(3).copy_from(&(offset * wp));
    let mut d_keyframe = SMatrix::<f64, 6, 6>::zeros();
    d_keyframe.fixed_view_mut::<3, 3>(0, 0).copy_from(&(-d_phi * turned.inverse().matrix() * wr));
    d_keyframe.fixed_view_mut::<3, 3>(3, 0).copy_from(&(offset.cross_matrix() * wp));
    d_keyframe.fixed_view_mut::<3, 3>(3, 3).copy_from(&(-Matrix3::identity() * wp));
    let mut d_chunk = SMatrix::<f64, 6, 7>::zeros();
    d_chunk.fixed_view_mut::<3, 3>(0, 0).copy_from(&(d_phi * c.rotation.inverse().matrix() * wr));
    let d_point = i_from_world.matrix() * world_from_k.d_act_d_perturbation(&c.translation);
    d_chunk.fixed_view_mut::<3, 7>(3, 0).copy_from(&(d_point * wp));
    let mut jacobians = vec![(Variable::Chunk(a.k), dynamic(d_chunk))];
    if a.moves_keyframe {
        jacobians.push((Variable::Keyframe(a.i), dynamic(d_keyframe)));
    }
    Some(Linearised { residual: residual.as_slice().to_vec(), jacobians })
}

fn relative(r: &RelativeChunk, world_from_k: &Sim3, world_from_l: &Sim3) -> Option<Linearised> {
    let predicted = world_from_l.inverse() * *world_from_k;
    let error = (r.l_from_k.inverse() * predicted).log();
    let d_k = Sim3::right_jacobian_inverse(&error)?;
    let d_l = -d_k * predicted.inverse().adjoint();
    Some(Linearised {
        residual: (*r.whitening * error).as_slice().to_vec(),
        jacobians: vec![
            (Variable::Chunk(r.k), dynamic(*r.whitening * d_k)),
            (Variable::Chunk(r.l), dynamic(*r.whitening * d_l)),
        ],
    })
}

fn gauge_prior(
    i: usize,
    world_from_i: &Se3,
    given: &Se3,
    position_std_m: f64,
    heading_std_rad: f64,
) -> Option<Linearised> {
    let phi = (world_from_i.rotation * given.rotation.inverse()).log();
    let turn = So3::right_jacobian_inverse(&phi)? * given.rotation.matrix() / heading_std_rad;
    let offset = (world_from_i.translation - given.translation) / position_std_m;
    let mut jacobian = DMatrix::zeros(4, 6);
    jacobian.view_mut((0, 3), (3, 3)).copy_from(&(world_from_i.rotation.matrix() / position_std_m));
    jacobian.view_mut((3, 0), (1, 3)).copy_from(&turn.row(2));
    let residual = vec![offset.x, offset.y, offset.z, phi.z / heading_std_rad];
    Some(Linearised { residual, jacobians: vec![(Variable::Keyframe(i), jacobian)] })
}

#[cfg(test)]
mod tests;
