//! Analytic shapes: where a ray meets them, how far a point is from them, and how their faces unroll into metres.
//!
//! Each face has coordinates `(u, v)` in metres on a rectangle of known size. Rectangles, boxes and cylinders unroll
//! without distortion; a sphere by longitude and height (Lambert's equal-area map), so that equal areas of `(u, v)`
//! are equal areas of surface everywhere.

use crate::extent::Extent;
use nalgebra::{Rotation3, Vector3};
use std::f64::consts::PI;

/// A place on a face.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FacePoint {
    /// Which of the shape's faces.
    pub face: usize,
    /// Coordinates on the face, m.
    pub uv: [f64; 2],
    /// Unit normal toward the seen side.
    pub normal: Vector3<f64>,
}

/// A solid or a sheet.
#[derive(Clone, Debug)]
pub(crate) enum Shape {
    /// A box seen from outside; `axes` are its unit directions in the world. Six faces −x, +x, −y, +y, −z, +z.
    Block { center: Vector3<f64>, axes: [Vector3<f64>; 3], half: [f64; 3] },
    /// An axis-aligned box seen from inside: the room itself. Six faces as a block's.
    Shell { min: Vector3<f64>, max: Vector3<f64> },
    /// A thin rectangle seen from both sides. One face.
    Sheet { corner: Vector3<f64>, u_axis: Vector3<f64>, v_axis: Vector3<f64>, size: [f64; 2] },
    /// A cylinder with caps. Faces: side, bottom, top.
    Cylinder { base: Vector3<f64>, frame: [Vector3<f64>; 3], radius: f64, height: f64 },
    /// A ball. One face.
    Ball { center: Vector3<f64>, radius: f64 },
}

/// Rays start this far along (in units of the direction's length, m for unit directions), so that they leave the
/// surface they came from.
pub(crate) const MIN_T: f64 = 1e-9;

/// The two face coordinates' axes for a box face that is normal to axis `a`.
const FACE_AXES: [[usize; 2]; 3] = [[1, 2], [0, 2], [0, 1]];

impl Shape {
    /// A box standing on `(x, y, z_bottom)` turned by `yaw` about z.
    pub(crate) fn block(foot: Vector3<f64>, size: [f64; 3], yaw: f64) -> Self {
        let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), yaw);
        let axes = [turn * Vector3::x(), turn * Vector3::y(), Vector3::z()];
        let center = foot + Vector3::new(0.0, 0.0, 0.5 * size[2]);
        Self::Block { center, axes, half: size.map(|s| 0.5 * s) }
    }

    /// A cylinder from `base` along the unit vector `axis`.
    pub(crate) fn cylinder(base: Vector3<f64>, axis: Vector3<f64>, radius: f64, height: f64) -> Self {
        let helper = if axis.z.abs() < 0.9 { Vector3::z() } else { Vector3::x() };
        let e1 = axis.cross(&helper).normalize();
        Self::Cylinder { base, frame: [e1, axis.cross(&e1), axis], radius, height }
    }

    /// Number of faces.
    pub(crate) fn face_count(&self) -> usize {
        match self {
            Self::Block { .. } | Self::Shell { .. } => 6,
            Self::Cylinder { .. } => 3,
            Self::Sheet { .. } | Self::Ball { .. } => 1,
        }
    }

    /// Size of a face's `(u, v)` rectangle, m.
    pub(crate) fn face_size(&self, face: usize) -> [f64; 2] {
        match self {
            Self::Block { half, .. } => FACE_AXES[face / 2].map(|a| 2.0 * half[a]),
            Self::Shell { min, max } => FACE_AXES[face / 2].map(|a| max[a] - min[a]),
            Self::Sheet { size, .. } => *size,
            Self::Cylinder { radius, height, .. } if face == 0 => [2.0 * PI * radius, *height],
            Self::Cylinder { radius, .. } => [2.0 * radius; 2],
            Self::Ball { radius, .. } => [2.0 * PI * radius, 2.0 * radius],
        }
    }

    /// The smallest axis-aligned box around the shape.
    pub(crate) fn extent(&self) -> Extent {
        let around =
            |center: Vector3<f64>, reach: Vector3<f64>| Extent { min: center - reach, max: center + reach };
        match self {
            Self::Block { center, axes, half } => {
                around(*center, (0..3).map(|k| axes[k].abs() * half[k]).sum())
            }
            Self::Shell { min, max } => Extent { min: *min, max: *max },
            Self::Sheet { corner, u_axis, v_axis, size } => {
                let (u, v) = (u_axis * size[0], v_axis * size[1]);
                Extent::around(&[*corner, corner + u, corner + v, corner + u + v])
            }
            Self::Cylinder { base, frame, radius, height } => {
                // A disc's reach along axis k is r·sqrt(1 − a_k²).
                let reach = frame[2].map(|a| radius * (1.0 - a * a).max(0.0).sqrt());
                around(*base, reach).union(&around(base + frame[2] * *height, reach))
            }
            Self::Ball { center, radius } => around(*center, Vector3::repeat(*radius)),
        }
    }

    /// The nearest `t` in (`MIN_T`, `limit`) at which `origin + t · direction` lies on the seen side's surface.
    #[inline]
    pub(crate) fn intersect(
        &self,
        origin: &Vector3<f64>,
        direction: &Vector3<f64>,
        limit: f64,
    ) -> Option<f64> {
        let within = |t: f64| (t > MIN_T && t < limit).then_some(t);
        match self {
            Self::Block { center, axes, half } => {
                let o = origin - center;
                let (mut enter, mut leave) = (f64::NEG_INFINITY, f64::INFINITY);
                for k in 0..3 {
                    let inverse = 1.0 / axes[k].dot(direction);
                    let at = -axes[k].dot(&o) * inverse;
                    let reach = half[k] * inverse.abs();
                    enter = enter.max(at - reach);
                    leave = leave.min(at + reach);
                }
                if enter <= leave { within(enter) } else { None }
            }
            Self::Shell { min, max } => {
                let mut leave = f64::INFINITY;
                for k in 0..3 {
                    let wall = if direction[k] > 0.0 { max[k] } else { min[k] };
                    if direction[k] != 0.0 {
                        leave = leave.min((wall - origin[k]) / direction[k]);
                    }
                }
                within(leave)
            }
            Self::Sheet { corner, u_axis, v_axis, size } => {
                let normal = u_axis.cross(v_axis);
                let o = corner - origin;
                let t = within(normal.dot(&o) / normal.dot(direction))?;
                let p = direction * t - o;
                let (u, v) = (u_axis.dot(&p), v_axis.dot(&p));
                (u >= 0.0 && v >= 0.0 && u <= size[0] && v <= size[1]).then_some(t)
            }
            Self::Cylinder { base, frame, radius, height } => {
                let o = origin - base;
                let local =
                    |v: &Vector3<f64>| Vector3::new(frame[0].dot(v), frame[1].dot(v), frame[2].dot(v));
                cylinder_hit(&local(&o), &local(direction), *radius, *height).and_then(within)
            }
            Self::Ball { center, radius } => {
                let o = origin - center;
                let (a, b) = (direction.norm_squared(), o.dot(direction));
                // The discriminant from the perpendicular part keeps its digits far away.
                let off = o - direction * (b / a);
                let d = radius * radius - off.norm_squared();
                if d < 0.0 { None } else { within((-b - (d * a).sqrt()) / a) }
            }
        }
    }

    /// Which face a surface point belongs to, seen along `direction`.
    pub(crate) fn resolve(&self, point: &Vector3<f64>, direction: &Vector3<f64>) -> FacePoint {
        match self {
            Self::Block { center, axes, half } => {
                let p = point - center;
                let local = [0, 1, 2].map(|k| axes[k].dot(&p));
                let axis = largest([0, 1, 2].map(|k| local[k].abs() - half[k]));
                let side = local[axis].signum();
                let [a, b] = FACE_AXES[axis];
                FacePoint {
                    face: 2 * axis + usize::from(side > 0.0),
                    uv: [local[a] + half[a], local[b] + half[b]],
                    normal: axes[axis] * side,
                }
            }
            Self::Shell { min, max } => {
                let (center, half) = ((min + max) * 0.5, (max - min) * 0.5);
                let local = point - center;
                let axis = largest([0, 1, 2].map(|k| local[k].abs() - half[k]));
                let side = local[axis].signum();
                let [a, b] = FACE_AXES[axis];
                let mut normal = Vector3::zeros();
                normal[axis] = -side;
                FacePoint {
                    face: 2 * axis + usize::from(side > 0.0),
                    uv: [point[a] - min[a], point[b] - min[b]],
                    normal,
                }
            }
            Self::Sheet { corner, u_axis, v_axis, .. } => {
                let p = point - corner;
                let normal = u_axis.cross(v_axis);
                let toward = if normal.dot(direction) > 0.0 { -normal } else { normal };
                FacePoint { face: 0, uv: [u_axis.dot(&p), v_axis.dot(&p)], normal: toward }
            }
            Self::Cylinder { base, frame, radius, height } => {
                let p = point - base;
                let [x, y, z] = [0, 1, 2].map(|k| frame[k].dot(&p));
                let out_of_side = x.hypot(y) - radius;
                if -z > out_of_side && -z > z - height {
                    FacePoint { face: 1, uv: [x + radius, y + radius], normal: -frame[2] }
                } else if z - height > out_of_side {
                    FacePoint { face: 2, uv: [x + radius, y + radius], normal: frame[2] }
                } else {
                    let normal = (frame[0] * x + frame[1] * y).normalize();
                    FacePoint { face: 0, uv: [(y.atan2(x) + PI) * radius, z], normal }
                }
            }
            Self::Ball { center, radius } => {
                let normal = (point - center).normalize();
                let u = (normal.y.atan2(normal.x) + PI) * radius;
                FacePoint { face: 0, uv: [u, (normal.z + 1.0) * radius], normal }
            }
        }
    }

    /// The surface point and its normal at `(u, v)` of a face; `None` off the face (outside a cylinder's round cap).
    pub(crate) fn at(&self, face: usize, uv: [f64; 2]) -> Option<(Vector3<f64>, Vector3<f64>)> {
        let side = if face % 2 == 1 { 1.0 } else { -1.0 };
        match self {
            Self::Block { center, axes, half } => {
                let axis = face / 2;
                let [a, b] = FACE_AXES[axis];
                let normal = axes[axis] * side;
                let on_face = axes[a] * (uv[0] - half[a]) + axes[b] * (uv[1] - half[b]);
                Some((center + on_face + normal * half[axis], normal))
            }
            Self::Shell { min, max } => {
                let axis = face / 2;
                let [a, b] = FACE_AXES[axis];
                let mut point = if side > 0.0 { *max } else { *min };
                point[a] = min[a] + uv[0];
                point[b] = min[b] + uv[1];
                let mut normal = Vector3::zeros();
                normal[axis] = -side;
                Some((point, normal))
            }
            Self::Sheet { corner, u_axis, v_axis, .. } => {
                Some((corner + u_axis * uv[0] + v_axis * uv[1], u_axis.cross(v_axis)))
            }
            Self::Cylinder { base, frame, radius, height } => {
                if face == 0 {
                    let angle = uv[0] / radius - PI;
                    let normal = frame[0] * angle.cos() + frame[1] * angle.sin();
                    return Some((base + normal * *radius + frame[2] * uv[1], normal));
                }
                let (x, y) = (uv[0] - radius, uv[1] - radius);
                let on_cap = base + frame[0] * x + frame[1] * y;
                let top = face == 2;
                let point = if top { on_cap + frame[2] * *height } else { on_cap };
                (x.hypot(y) <= *radius).then(|| (point, if top { frame[2] } else { -frame[2] }))
            }
            Self::Ball { center, radius } => {
                let (angle, z) = (uv[0] / radius - PI, (uv[1] / radius - 1.0).clamp(-1.0, 1.0));
                let ring = (1.0 - z * z).sqrt();
                let normal = Vector3::new(ring * angle.cos(), ring * angle.sin(), z);
                Some((center + normal * *radius, normal))
            }
        }
    }

    /// Distance from `point` to the surface, m.
    pub(crate) fn distance(&self, point: &Vector3<f64>) -> f64 {
        match self {
            Self::Block { center, axes, half } => {
                let p = point - center;
                box_distance([0, 1, 2].map(|k| axes[k].dot(&p).abs() - half[k]))
            }
            Self::Shell { min, max } => {
                let (center, half) = ((min + max) * 0.5, (max - min) * 0.5);
                let p = (point - center).abs() - half;
                box_distance([p.x, p.y, p.z])
            }
            Self::Sheet { corner, u_axis, v_axis, size } => {
                let p = point - corner;
                let (u, v) = (u_axis.dot(&p).clamp(0.0, size[0]), v_axis.dot(&p).clamp(0.0, size[1]));
                (p - u_axis * u - v_axis * v).norm()
            }
            Self::Cylinder { base, frame, radius, height } => {
                let p = point - base;
                let [x, y, z] = [0, 1, 2].map(|k| frame[k].dot(&p));
                let half = 0.5 * height;
                box_distance([x.hypot(y) - radius, (z - half).abs() - half, f64::NEG_INFINITY])
            }
            Self::Ball { center, radius } => ((point - center).norm() - radius).abs(),
        }
    }
}

/// Distance to the surface of a box from the signed distances to its pairs of faces.
fn box_distance(outside: [f64; 3]) -> f64 {
    let nearest = outside.into_iter().fold(f64::NEG_INFINITY, f64::max);
    if nearest <= 0.0 {
        return -nearest;
    }
    outside.into_iter().map(|d| d.max(0.0).powi(2)).sum::<f64>().sqrt()
}

fn largest(values: [f64; 3]) -> usize {
    let first = if values[1] > values[0] { 1 } else { 0 };
    if values[2] > values[first] { 2 } else { first }
}

/// Where a ray enters the cylinder of `radius` about z between 0 and `height`.
fn cylinder_hit(o: &Vector3<f64>, d: &Vector3<f64>, radius: f64, height: f64) -> Option<f64> {
    let inverse = 1.0 / d.z;
    let (z0, z1) = (-o.z * inverse, (height - o.z) * inverse);
    let (mut enter, mut leave) = (z0.min(z1), z0.max(z1));
    let a = d.x * d.x + d.y * d.y;
    if a > 1e-18 * d.z * d.z {
        let b = (o.x * d.x + o.y * d.y) / a;
        let (px, py) = (o.x - d.x * b, o.y - d.y * b);
        let square = (radius * radius - px * px - py * py) / a;
        if square < 0.0 {
            return None;
        }
        let reach = square.sqrt();
        enter = enter.max(-b - reach);
        leave = leave.min(-b + reach);
    } else if o.x.hypot(o.y) > radius {
        return None;
    }
    (enter <= leave).then_some(enter)
}
