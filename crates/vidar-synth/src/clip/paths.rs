//! Where the views of a clip are taken from.
//!
//! Flights keep the speed of the built-in courses; hand-held paths walk and turn by small uneven steps, or walk round
//! something and look at it; in homes they inspect objects at close range. Steps between neighbouring views
//! are 5 to 70 cm and up to about 20°.

use crate::extent::Extent;
use crate::rig::euroc_body_from_camera;
use crate::simulation::Simulation;
use crate::world::World;
use nalgebra::{Matrix3, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use std::f64::consts::PI;
use vidar_core::{Se3, So3};

/// Room that a hand-held camera keeps to the nearest surface, m.
const CLEARANCE_M: f64 = 0.3;

/// Attempts to find a free place before the last one is taken.
const TRIES: usize = 24;

/// Poses (`world_from_camera`) of `views` views.
pub(super) fn path(simulation: &Simulation, views: usize, rng: &mut ChaCha8Rng) -> Vec<Se3> {
    match rng.random_range(0..20) {
        0..7 => along_flight(simulation, views, rng),
        7..14 => walk(simulation.world(), views, rng),
        _ => walk_round(simulation.world(), views, rng),
    }
}

/// Poses of `views` views in a home: mostly inspecting objects at close range.
pub(super) fn home_path(simulation: &Simulation, views: usize, rng: &mut ChaCha8Rng) -> Vec<Se3> {
    let world = simulation.world();
    match rng.random_range(0..20) {
        0..12 => inspection(world, views, rng),
        12..16 => walk(world, views, rng),
        _ => walk_round(world, views, rng),
    }
}

fn uniform(rng: &mut ChaCha8Rng, low: f64, high: f64) -> f64 {
    low + (high - low) * rng.random::<f64>()
}

/// Roughly normal, of deviation 1.
fn normal(rng: &mut ChaCha8Rng) -> f64 {
    (0..3).map(|_| uniform(rng, -1.0, 1.0)).sum()
}

fn along_flight(simulation: &Simulation, views: usize, rng: &mut ChaCha8Rng) -> Vec<Se3> {
    let flight = simulation.path();
    let longest = flight.duration_secs();
    let step = (0.08 * uniform(rng, 0.0, 1.9).exp()).min(longest / views as f64);
    let start = uniform(rng, 0.0, (longest - step * views as f64).max(0.0));
    (0..views)
        .map(|k| {
            let secs = start + step * (k as f64 + uniform(rng, 0.0, 0.5));
            flight.world_from_body(secs.min(longest)) * euroc_body_from_camera()
        })
        .collect()
}

/// A free place within the room at the height of a hand or a head.
fn free_place(world: &World, rng: &mut ChaCha8Rng) -> Vector3<f64> {
    let room = world.extent();
    let size = room.max - room.min;
    let mut place = room.center();
    for _ in 0..TRIES {
        let at = |rng: &mut ChaCha8Rng, k: usize| room.min[k] + size[k] * uniform(rng, 0.08, 0.92);
        let height = uniform(rng, 0.6, 2.4_f64.min(size.z - 0.4));
        place = Vector3::new(at(rng, 0), at(rng, 1), room.min.z + height);
        if world.clearance_m(&place) > CLEARANCE_M {
            break;
        }
    }
    place
}

/// One step of about `length` that stays free, along `heading` if possible.
fn free_step(
    world: &World,
    from: &Vector3<f64>,
    heading: &mut f64,
    length: f64,
    rng: &mut ChaCha8Rng,
) -> Vector3<f64> {
    for attempt in 0..TRIES {
        let turn = (0.25 + 0.15 * attempt as f64) * normal(rng);
        let along = *heading + turn;
        let stride = length * uniform(rng, 0.6, 1.3);
        let to = from + Vector3::new(along.cos(), along.sin(), 0.15 * normal(rng)) * stride;
        if world.clearance_m(&to) > CLEARANCE_M {
            *heading = along;
            return to;
        }
    }
    *from
}

/// The length of a clip's steps, m: 5 to 60 cm, short ones as often as long ones by ratio.
fn stride(rng: &mut ChaCha8Rng) -> f64 {
    0.05 * uniform(rng, 0.0, 2.5).exp()
}

/// Walks somewhere, looking about.
fn walk(world: &World, views: usize, rng: &mut ChaCha8Rng) -> Vec<Se3> {
    let mut place = free_place(world, rng);
    let length = stride(rng);
    let mut heading = uniform(rng, -PI, PI);
    let mut yaw = uniform(rng, -PI, PI);
    // Half of the clips hardly turn, the others sweep one way.
    let turn = if rng.random::<bool>() { 0.0 } else { uniform(rng, -0.3, 0.3) };
    let (tilt, lean) = (0.2 * normal(rng), 0.07 * normal(rng));
    let unrest = uniform(rng, 0.01, 0.07);
    (0..views)
        .map(|_| {
            let (pitch, roll) = (tilt + unrest * normal(rng), lean + unrest * normal(rng));
            let pose = Se3::new(looking(yaw, pitch, roll), place);
            yaw += turn + unrest * normal(rng);
            place = free_step(world, &place, &mut heading, length, rng);
            pose
        })
        .collect()
}

/// The point at which a hand-held camera is directed.
struct ViewTarget {
    target: Vector3<f64>,
    /// By how much the target moves from view to view, m.
    wander: Vector3<f64>,
    /// Roll, and the deviation of all three angles, rad.
    lean: f64,
    unrest: f64,
}

impl ViewTarget {
    /// Poses from `place` on, a free step of about `length` apart, beginning along `heading`.
    fn while_stepping(
        mut self,
        world: &World,
        mut place: Vector3<f64>,
        mut heading: f64,
        length: f64,
        views: usize,
        rng: &mut ChaCha8Rng,
    ) -> Vec<Se3> {
        let (lean, unrest) = (self.lean, self.unrest);
        (0..views)
            .map(|_| {
                let to = self.target - place;
                let (yaw, pitch) = (to.y.atan2(to.x), -(to.z.atan2(to.x.hypot(to.y))));
                let (yaw, pitch) = (yaw + unrest * normal(rng), pitch + unrest * normal(rng));
                let pose = Se3::new(looking(yaw, pitch.clamp(-1.2, 1.2), lean + unrest * normal(rng)), place);
                place = free_step(world, &place, &mut heading, length, rng);
                self.target += self.wander;
                pose
            })
            .collect()
    }
}

/// Walks sideways round something and keeps it about the middle of the view.
fn walk_round(world: &World, views: usize, rng: &mut ChaCha8Rng) -> Vec<Se3> {
    let place = free_place(world, rng);
    let yaw = uniform(rng, -PI, PI);
    let pitch = 0.15 + 0.2 * normal(rng);
    let ahead = looking(yaw, pitch, 0.0) * Vector3::z();
    let reach = world.cast(&place, &ahead).map_or(2.0, |hit| hit.t);
    let target = place + ahead * (reach * uniform(rng, 0.6, 1.1));
    let length = stride(rng).min(0.3 * reach);
    let heading = yaw + 0.5 * PI * if rng.random::<bool>() { 1.0 } else { -1.0 } + 0.4 * normal(rng);
    let lean = 0.07 * normal(rng);
    let unrest = uniform(rng, 0.01, 0.06);
    let view_target = ViewTarget { target, wander: Vector3::zeros(), lean, unrest };
    view_target.while_stepping(world, place, heading, length, views, rng)
}

/// Looks over something from 0.5 to 2.3 m, mostly from above, while stepping aside and letting the eye wander.
fn inspection(world: &World, views: usize, rng: &mut ChaCha8Rng) -> Vec<Se3> {
    let Some((place, target)) = vantage(world, rng) else { return walk_round(world, views, rng) };
    let reach = (target - place).norm();
    let length = stride(rng).min(0.25 * reach);
    let to = target - place;
    let side = if rng.random::<bool>() { 0.5 * PI } else { -0.5 * PI };
    let heading = to.y.atan2(to.x) + side + 0.6 * normal(rng);
    let wander = Vector3::new(normal(rng), normal(rng), 0.3 * normal(rng)) * (0.04 * reach);
    let (lean, unrest) = (0.08 * normal(rng), uniform(rng, 0.01, 0.05));
    let view_target = ViewTarget { target, wander, lean, unrest };
    view_target.while_stepping(world, place, heading, length, views, rng)
}

/// A free place and an object that is seen from there.
fn vantage(world: &World, rng: &mut ChaCha8Rng) -> Option<(Vector3<f64>, Vector3<f64>)> {
    // The first shape is the room itself.
    let (room, objects) = (world.extent(), &world.shapes()[1..]);
    for _ in 0..8 * TRIES {
        let object = objects.get(rng.random_range(0..objects.len().max(1)))?.extent();
        let middle = object.center();
        let target = Vector3::new(middle.x, middle.y, object.max.z.min(room.max.z - 0.8));
        let (azimuth, elevation) = (uniform(rng, -PI, PI), uniform(rng, 0.05, 0.95));
        let away = uniform(rng, 0.5, 2.3);
        let (sin, cos) = elevation.sin_cos();
        let place = target + Vector3::new(cos * azimuth.cos(), cos * azimuth.sin(), sin) * away;
        let height = place.z - room.min.z;
        let inside = room.grown(-CLEARANCE_M).holds(&Extent { min: place, max: place });
        if !inside || !(0.5..2.2).contains(&height) || world.clearance_m(&place) < CLEARANCE_M {
            continue;
        }
        let seen = world.cast(&place, &(target - place)).is_some_and(|hit| hit.t > 0.75);
        if seen {
            return Some((place, target));
        }
    }
    None
}

/// Rotation of a camera that looks along `yaw` about the world's z, `pitch` downward, rolled about its axis; radians.
fn looking(yaw: f64, pitch: f64, roll: f64) -> So3 {
    // Columns: the camera's axes in the world at zero angles; right = −y, down = −z, ahead = +x.
    let level = Matrix3::new(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0);
    let level = So3::from_matrix(&level).unwrap_or(So3::IDENTITY);
    let about_z = So3::from_axis_angle(&Vector3::z(), yaw);
    let about_y = So3::from_axis_angle(&Vector3::y(), pitch);
    about_z * about_y * level * So3::from_axis_angle(&Vector3::z(), roll)
}
