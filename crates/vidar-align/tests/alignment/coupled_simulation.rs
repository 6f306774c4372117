//! The coupled graph against the paper's two couplings, in a simulated flat of which everything is known.
//!
//! Three laps of a 3 m loop with 360 keyframes, 16 cm apart; chunks of 30 that overlap by 10. The odometry drifts by 0.6 % of
//! its step, a slow scale error and 0.06° of heading per keyframe (times `vio`). A chunk has a gauge of its own and a
//! correlated deformation: rotation walks by 0.12°, translation by 1.2 % of the step and scale by 0.15 % per keyframe. The
//! loops between chunks are measured to 0.4°, 3 cm and 1 %; some are false. No number here forecasts real data; what is
//! claimed is the order of the three.

use nalgebra::{Matrix6, SMatrix, SVector, UnitVector3, Vector3, Vector6};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{RngCore, SeedableRng};
use vidar_align::coupled::{
    Attachment, CoupledConfig, CoupledState, Factor, InformationFlow, Kernel, RelativeChunk, inflation, solve,
};
use vidar_align::streaming::{
    ChunkRange, LoopConstraint, PoseGraphConfig, accumulate, chunk_ranges, optimise_chain,
};
use vidar_core::{LieGroup, Se3, Sim3, So3, umeyama_sim3};

const KEYFRAMES: usize = 360;

struct Noise(ChaCha8Rng);

impl Noise {
    fn uniform(&mut self) -> f64 {
        (self.0.next_u64() >> 11) as f64 / (1u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }

    fn vector(&mut self, std: f64) -> Vector3<f64> {
        Vector3::new(self.normal(), self.normal(), self.normal()) * std
    }
}

struct Chunk {
    range: ChunkRange,
    /// The model's poses, chunk units.
    poses: Vec<Se3>,
    /// Chunk units per metre of each depth map.
    depth_factor: Vec<f64>,
    world_from_chunk: Sim3,
}

struct World {
    truth: Vec<Se3>,
    odometry: Vec<Se3>,
    relative: Vec<Se3>,
    step_m: Vec<f64>,
    vio: f64,
    chunks: Vec<Chunk>,
    overlaps: Vec<Sim3>,
    loops: Vec<LoopConstraint>,
    /// Measured ln(chunk units per metre), from landmarks.
    landmark_log: Vec<f64>,
    /// Points of each view, in its camera, m.
    seen: Vec<Vector3<f64>>,
}

fn rigid(similarity: &Sim3, pose: &Se3) -> Se3 {
    similarity.transform_pose(pose)
}

/// The rotation that fits pairs of rotations best, `Σ a bᵀ` projected.
fn mean_rotation(pairs: impl Iterator<Item = (So3, So3)>) -> So3 {
    let sum = pairs.fold(nalgebra::Matrix3::zeros(), |m, (a, b)| m + a.matrix() * b.matrix().transpose());
    So3::from_matrix(&vidar_core::nearest_rotation(&sum).unwrap().rotation).unwrap()
}

fn rigid_fit(source: &[Vector3<f64>], target: &[Vector3<f64>]) -> Se3 {
    vidar_core::umeyama_se3(source, target).unwrap()
}

fn simulate(seed: u64, vio: f64, false_loops: usize) -> World {
    let mut noise = Noise(ChaCha8Rng::seed_from_u64(seed));
    let n = KEYFRAMES;
    let truth: Vec<Se3> = (0..n)
        .map(|i| {
            let a = std::f64::consts::TAU * 3.0 * i as f64 / (n - 1) as f64;
            let radius = 3.0 + 0.4 * (5.0 * a / 3.0).sin();
            let heading = a + std::f64::consts::FRAC_PI_2 + 0.6 * (0.7 * a).sin();
            let tilt = So3::exp(&Vector3::new(0.08 * (3.0 * a).sin(), 0.06 * (2.0 * a).cos(), 0.0));
            Se3 {
                rotation: So3::from_axis_angle(&Vector3::z(), heading) * tilt,
                translation: Vector3::new(
                    radius * a.cos(),
                    radius * a.sin(),
                    0.4 * (2.0 * a).sin() + 0.1 * a / 6.0,
                ),
            }
        })
        .collect();
    let between = |poses: &[Se3]| poses.windows(2).map(|p| p[0].inverse() * p[1]).collect::<Vec<_>>();
    let (mut slow, fixed) = (0.0, 0.003 * noise.normal());
    let relative: Vec<Se3> = between(&truth)
        .into_iter()
        .map(|r| {
            slow += noise.normal() / (n as f64).sqrt();
            let scale = 1.0 + vio * (0.012 * slow + fixed);
            let spread = vio * 0.01 * r.translation.norm();
            let turn = Vector3::new(0.01 * noise.normal(), 0.01 * noise.normal(), 0.06 * noise.normal());
            Se3 {
                rotation: r.rotation * So3::exp(&(turn * vio.to_radians())),
                translation: r.translation * scale + noise.vector(spread),
            }
        })
        .collect();
    let mut odometry = vec![truth[0]];
    relative.iter().for_each(|r| odometry.push(odometry[odometry.len() - 1] * *r));
    let step_m: Vec<f64> = between(&truth).iter().map(|r| r.translation.norm()).collect();

    let chunks: Vec<Chunk> = chunk_ranges(n, 30, 10)
        .unwrap()
        .into_iter()
        .map(|range| {
            let rotation = So3::exp(&noise.vector(1.0));
            let gauge = Sim3::new(rotation, noise.vector(3.0), (0.3 * noise.normal()).exp()).unwrap();
            let inside = &truth[range.frames.clone()];
            let (mut poses, mut walk, mut stretch) = (vec![inside[0]], 0.0_f64, vec![1.0]);
            for r in between(inside) {
                walk += 0.0015 * noise.normal();
                stretch.push(walk.exp());
                let bent = Se3 {
                    rotation: r.rotation * So3::exp(&noise.vector(0.12_f64.to_radians())),
                    translation: r.translation * walk.exp() + noise.vector(0.012 * r.translation.norm()),
                };
                poses.push(poses[poses.len() - 1] * bent);
            }
            poses.iter_mut().for_each(|p| p.translation += noise.vector(0.004));
            let centers = |p: &[Se3]| p.iter().map(|p| p.translation).collect::<Vec<_>>();
            let placed = rigid_fit(&centers(&poses), &centers(inside));
            let mean = stretch.iter().sum::<f64>() / stretch.len() as f64;
            let chunk_from_world = gauge.inverse();
            Chunk {
                poses: poses.iter().map(|p| rigid(&chunk_from_world, &(placed * *p))).collect(),
                depth_factor: stretch
                    .iter()
                    .map(|s| s / mean * (0.004 * noise.normal()).exp() / gauge.scale)
                    .collect(),
                world_from_chunk: gauge,
                range,
            }
        })
        .collect();
    // What a view sees: between 1.2 and 4 m ahead along x.
    let seen: Vec<Vector3<f64>> = (0..25)
        .map(|_| {
            let depth = 1.2 + 2.8 * noise.uniform();
            Vector3::new(depth, -1.2 * noise.normal() * depth / 2.5, -0.8 * noise.normal() * depth / 2.5)
        })
        .collect();
    let points = |chunk: &Chunk, frame: usize| {
        let local = frame - chunk.range.frames.start;
        let (pose, factor) = (chunk.poses[local], chunk.depth_factor[local]);
        seen.iter().map(move |p| pose.act(&(p * factor))).collect::<Vec<_>>()
    };
    let overlaps = chunks
        .windows(2)
        .map(|pair| {
            let shared = pair[1].range.frames.start..pair[0].range.frames.end;
            let of = |c: &Chunk| shared.clone().flat_map(|f| points(c, f)).collect::<Vec<_>>();
            umeyama_sim3(&of(&pair[1]), &of(&pair[0])).unwrap()
        })
        .collect();
    let mut loops = Vec::new();
    let middle = |c: &Chunk| truth[(c.range.frames.start + c.range.frames.end) / 2].translation;
    for a in 0..chunks.len() {
        for b in 0..a.saturating_sub(3) {
            if (middle(&chunks[a]) - middle(&chunks[b])).norm() < 0.7 {
                let exact = chunks[b].world_from_chunk.inverse() * chunks[a].world_from_chunk;
                let b_from_a = Sim3 {
                    rotation: exact.rotation * So3::exp(&noise.vector(0.4_f64.to_radians())),
                    translation: exact.translation + noise.vector(0.03 / chunks[b].world_from_chunk.scale),
                    scale: exact.scale * (0.01 * noise.normal()).exp(),
                };
                loops.push(LoopConstraint { a, b, b_from_a });
            }
        }
    }
    for k in 0..false_loops {
        let rotation = So3::exp(&noise.vector(0.5));
        let b_from_a = Sim3::new(rotation, noise.vector(1.0), (0.1 * noise.normal()).exp()).unwrap();
        loops.push(LoopConstraint { a: 6 + (5 * k + seed as usize) % 12, b: k % 3, b_from_a });
    }
    let landmark_log = chunks
        .iter()
        .map(|c| {
            (c.depth_factor.iter().sum::<f64>() / c.depth_factor.len() as f64).ln() + 0.01 * noise.normal()
        })
        .collect();
    World { truth, odometry, relative, step_m, vio, chunks, overlaps, loops, landmark_log, seen }
}

/// Poses and the metres per depth unit of every view, compared after a rigid fit only: metric ATE, and the share of seen
/// points within 5 cm.
fn errors_of(world: &World, poses: &[Se3], metres_per_unit: impl Fn(usize) -> f64) -> (f64, f64) {
    let centers = |p: &[Se3]| p.iter().map(|p| p.translation).collect::<Vec<_>>();
    let fit = rigid_fit(&centers(poses), &centers(&world.truth));
    let squares: f64 = poses
        .iter()
        .zip(&world.truth)
        .map(|(p, t)| (fit.act(&p.translation) - t.translation).norm_squared())
        .sum();
    let (mut near, mut all) = (0usize, 0usize);
    for (frame, (pose, truth)) in poses.iter().zip(&world.truth).enumerate() {
        let chunk = &world.chunks[owner(world, frame)];
        let factor = chunk.depth_factor[frame - chunk.range.frames.start] * metres_per_unit(frame);
        for p in &world.seen {
            near += usize::from((fit.act(&pose.act(&(p * factor))) - truth.act(p)).norm() < 0.05);
            all += 1;
        }
    }
    ((squares / poses.len() as f64).sqrt(), near as f64 / all as f64)
}

fn owner(world: &World, frame: usize) -> usize {
    world.chunks.iter().rposition(|c| c.range.frames.start <= frame).unwrap()
}

/// The paper's pose-conditioned coupling: odometry's poses, each chunk's depth divided by its Umeyama scale.
fn pose_conditioned(world: &World) -> (f64, f64) {
    let scales: Vec<f64> = world
        .chunks
        .iter()
        .map(|c| {
            let centers = |p: &[Se3]| p.iter().map(|p| p.translation).collect::<Vec<_>>();
            umeyama_sim3(&centers(&c.poses), &centers(&world.odometry[c.range.frames.clone()])).unwrap().scale
        })
        .collect();
    errors_of(world, &world.odometry, |frame| scales[owner(world, frame)])
}

/// The paper's hybrid: the reference's own graph, then one similarity onto the odometry's centres.
fn hybrid(world: &World) -> (f64, f64) {
    let chain = optimise_chain(&world.overlaps, &world.loops, &PoseGraphConfig::default()).unwrap();
    let mut gauges = vec![Sim3::IDENTITY];
    gauges.extend(accumulate(&chain.previous_from_next));
    let place = |gauges: &[Sim3]| -> Vec<Se3> {
        (0..KEYFRAMES)
            .map(|f| {
                let (k, chunk) = (owner(world, f), &world.chunks[owner(world, f)]);
                rigid(&gauges[k], &chunk.poses[f - chunk.range.frames.start])
            })
            .collect()
    };
    let centers = |p: &[Se3]| p.iter().map(|p| p.translation).collect::<Vec<_>>();
    let onto = umeyama_sim3(&centers(&place(&gauges)), &centers(&world.odometry)).unwrap();
    gauges.iter_mut().for_each(|g| *g = onto * *g);
    errors_of(world, &place(&gauges), |frame| gauges[owner(world, frame)].scale)
}

fn coupled(world: &World) -> (f64, f64) {
    let chunks = world
        .chunks
        .iter()
        .zip(&world.landmark_log)
        .map(|(c, log)| {
            let metric = &world.odometry[c.range.frames.clone()];
            let rotation = mean_rotation(metric.iter().zip(&c.poses).map(|(m, p)| (m.rotation, p.rotation)));
            let mean = |p: &[Se3]| p.iter().map(|p| p.translation).sum::<Vector3<f64>>() / p.len() as f64;
            let turned = Sim3::new(rotation, Vector3::zeros(), (-log).exp()).unwrap();
            Sim3 { translation: mean(metric) - turned.act(&mean(&c.poses)), ..turned }
        })
        .collect();
    let start = CoupledState { keyframes: world.odometry.clone(), chunks };
    let mut factors = vec![Factor::GaugePrior {
        i: 0,
        world_from_camera: world.odometry[0],
        position_std_m: 1e-3,
        heading_std_rad: 1e-3,
    }];
    for (i, (relative, step)) in world.relative.iter().zip(&world.step_m).enumerate() {
        let position = world.vio * (0.0102 * step).max(0.0008);
        let turn = |deg: f64| 1.0 / (world.vio * deg.to_radians());
        let whitening = Vector6::new(turn(0.03), turn(0.03), turn(0.06), 1.0, 1.0, 1.0)
            .component_mul(&Vector6::new(1.0, 1.0, 1.0, 1.0 / position, 1.0 / position, 1.0 / position));
        factors.push(Factor::Odometry {
            i,
            j: i + 1,
            i_from_j: *relative,
            whitening: Box::new(Matrix6::from_diagonal(&whitening)),
        });
    }
    for (i, pose) in world.odometry.iter().enumerate() {
        let up_in_camera = UnitVector3::new_normalize(pose.rotation.inverse().act(&Vector3::z()));
        factors.push(Factor::Gravity { i, up_in_camera, std_rad: 0.3_f64.to_radians() });
    }
    let robust = Kernel::Cauchy { k: 3.0 };
    for (k, c) in world.chunks.iter().enumerate() {
        let widened = inflation(c.poses.len());
        for (local, pose) in c.poses.iter().enumerate() {
            factors.push(Factor::Attachment(Attachment {
                i: c.range.frames.start + local,
                k,
                chunk_from_camera: *pose,
                rotation_std_rad: widened * 0.45_f64.to_radians(),
                position_std_m: widened * 0.012,
                kernel: robust,
                moves_keyframe: true,
            }));
        }
        factors.push(Factor::Scale { k, log_scale: -world.landmark_log[k], std: 0.01, kernel: robust });
    }
    let link = |k: usize, l, l_from_k, rotation_deg: f64, translation_std_m: f64, log_scale_std, kernel| {
        let translation = translation_std_m / start.chunks[k].scale;
        let rotation = rotation_deg.to_radians();
        let stds = [rotation, rotation, rotation, translation, translation, translation, log_scale_std];
        let covariance = SMatrix::from_diagonal(&SVector::from(stds.map(|s| s * s)));
        Factor::Relative(RelativeChunk::from_covariance(k, l, l_from_k, &covariance, kernel).unwrap())
    };
    for (l, l_from_k) in world.overlaps.iter().enumerate() {
        factors.push(link(l + 1, l, *l_from_k, 1.2, 0.06, 0.018, robust));
    }
    for l in &world.loops {
        factors.push(link(l.a, l.b, l.b_from_a, 0.6, 0.04, 0.015, Kernel::GemanMcClure { k: 4.0 }));
    }
    let solved = solve(&start, &factors, &CoupledConfig::default()).unwrap();
    assert_eq!(solved.flow, InformationFlow::Coupled, "{}", solved.odometry_chi2);
    let gauges = &solved.state.chunks;
    assert!(gauges.iter().all(Sim3::is_finite));
    errors_of(world, &solved.state.keyframes, |frame| gauges[owner(world, frame)].scale)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

#[test]
fn coupling_is_at_least_as_good_as_the_better_of_the_papers_two_in_every_regime() {
    // `SVector` only names the tangent here; a wrong order of it would show as a worse result, not as an error.
    let _: SVector<f64, 7> = Sim3::IDENTITY.log();
    for (vio, false_loops) in [(1.0, 0), (3.0, 0), (1.0, 3)] {
        let worlds: Vec<World> = (0..5).map(|seed| simulate(seed, vio, false_loops)).collect();
        let all = |f: fn(&World) -> (f64, f64)| {
            let results: Vec<(f64, f64)> = worlds.iter().map(f).collect();
            (median(results.iter().map(|r| r.0).collect()), median(results.iter().map(|r| r.1).collect()))
        };
        let (conditioned, hybrid, coupled) = (all(pose_conditioned), all(hybrid), all(coupled));
        let shown = format!(
            "vio x{vio}, {false_loops} false loops: (ATE m, points within 5 cm) pose-conditioned {conditioned:.3?}, \
             hybrid {hybrid:.3?}, coupled {coupled:.3?}"
        );
        assert!(coupled.0 <= conditioned.0.min(hybrid.0), "{shown}");
        assert!(coupled.1 >= conditioned.1.max(hybrid.1), "{shown}");
    }
}

#[test]
fn each_of_the_papers_two_fails_in_its_own_regime() {
    let drifting = simulate(1, 3.0, 0);
    assert!(hybrid(&drifting).0 < pose_conditioned(&drifting).0);
    let misled = simulate(1, 1.0, 3);
    assert!(pose_conditioned(&misled).0 < hybrid(&misled).0);
}
