//! Viewpoints of map pictures.

use nalgebra::{Matrix3, Vector3};
use vidar_core::{StampedPose, Trajectory};

/// Two horizontal directions and up, as a right-handed frame with names for axes.
pub(crate) struct HorizontalPlane {
    /// Rows: right, away, up.
    rows: Matrix3<f64>,
    /// Names of the three directions (`x`, `-z`).
    pub names: [String; 3],
}

impl HorizontalPlane {
    /// The plane across `up`. An `up` along an axis of the world keeps the world's axes.
    pub(crate) fn of_up(up: &Vector3<f64>) -> Self {
        let up =
            up.try_normalize(1e-12).filter(|u| u.iter().all(|v| v.is_finite())).unwrap_or_else(Vector3::z);
        let axis = up.iamax();
        let rising = up[axis] > 0.0;
        let (right, away) = match (axis, rising) {
            (0, true) => (Vector3::y(), Vector3::z()),
            (0, false) => (Vector3::z(), Vector3::y()),
            (1, true) => (Vector3::x(), -Vector3::z()),
            (1, false) => (Vector3::x(), Vector3::z()),
            (_, true) => (Vector3::x(), Vector3::y()),
            (_, false) => (Vector3::x(), -Vector3::y()),
        };
        if up[axis].abs() > 1.0 - 1e-9 {
            let rows = Matrix3::from_rows(&[right.transpose(), away.transpose(), up.transpose()]);
            return Self { rows, names: [axis_name(&right), axis_name(&away), axis_name(&up)] };
        }
        let right = (right - up * right.dot(&up)).normalize();
        let away = up.cross(&right);
        let rows = Matrix3::from_rows(&[right.transpose(), away.transpose(), up.transpose()]);
        Self { rows, names: ["horizontal 1", "horizontal 2", "height"].map(str::to_owned) }
    }

    /// Coordinates of a point of the world along right, away, up.
    pub(crate) fn coordinates(&self, p: &Vector3<f64>) -> [f64; 3] {
        let q = self.rows * p;
        [q.x, q.y, q.z]
    }

    fn direction(&self, right: f64, away: f64, up: f64) -> Vector3<f64> {
        self.rows.transpose() * Vector3::new(right, away, up)
    }
}

fn axis_name(direction: &Vector3<f64>) -> String {
    let axis = direction.iamax();
    let sign = if direction[axis] < 0.0 { "-" } else { "" };
    format!("{sign}{}", ["x", "y", "z"][axis])
}

/// Which way is up in a world that may not have z up, estimated from the cameras, which are usually held level.
///
/// Takes the mean of the cameras' upward image axis. Within 35° of z it is z, the project's own convention;
/// within 20° of another axis it is that axis; otherwise the mean itself. `camera_path` must hold poses of a camera
/// (x right, y down, z forward). Without poses it is z.
pub fn up_of_world(camera_path: &Trajectory) -> Vector3<f64> {
    let sum: Vector3<f64> =
        camera_path.poses().iter().map(|p| p.world_from_body.rotation * -Vector3::y()).sum();
    let Some(mean) = sum.try_normalize(1e-6) else { return Vector3::z() };
    if mean.z > 35f64.to_radians().cos() {
        return Vector3::z();
    }
    let axis = mean.iamax();
    if mean[axis].abs() > 20f64.to_radians().cos() {
        return Vector3::ith(axis, mean[axis].signum());
    }
    mean
}

/// How points become pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Projection {
    /// Parallel: equal lengths stay equal.
    Orthographic {
        /// World length of the picture's height, metres.
        height_m: f64,
    },
    /// Through a point.
    Perspective {
        /// Angle across the picture's height, degrees, within 1…170.
        vertical_angle_deg: f64,
    },
}

/// How surfaces seen from behind are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BackFaces {
    /// They are not drawn: the inside of a room is visible from outside.
    Cull,
    /// They are drawn darker and greyer.
    Dim,
}

/// A fixed place to look at a map from.
#[derive(Clone, Debug, PartialEq)]
pub struct MapCamera {
    /// Name for captions and files (`top`).
    pub name: String,
    /// Its position, metres, world.
    pub position: Vector3<f64>,
    /// Unit direction of the picture's columns towards the right, world.
    pub right: Vector3<f64>,
    /// Unit direction of the picture's rows downwards, world.
    pub down: Vector3<f64>,
    /// How points become pixels.
    pub projection: Projection,
    /// How surfaces seen from behind are drawn.
    pub back_faces: BackFaces,
}

/// The fixed viewpoints of a run's pictures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Viewpoint {
    /// From straight above, parallel.
    Top,
    /// From above and the front right.
    ThreeQuarterFront,
    /// From above and the back left.
    ThreeQuarterBack,
    /// From the centre of the camera's path, in the cameras' viewing direction.
    Inside,
}

impl Viewpoint {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Top, Self::ThreeQuarterFront, Self::ThreeQuarterBack, Self::Inside];

    /// Short name, fit for a file.
    pub fn name(self) -> &'static str {
        match self {
            Self::Top => "top",
            Self::ThreeQuarterFront => "three-quarter-front",
            Self::ThreeQuarterBack => "three-quarter-back",
            Self::Inside => "inside",
        }
    }

    /// Name for captions.
    pub fn caption(self) -> &'static str {
        match self {
            Self::Top => "From above",
            Self::ThreeQuarterFront => "Three-quarter view from the front",
            Self::ThreeQuarterBack => "Three-quarter view from the back",
            Self::Inside => "From inside",
        }
    }
}

impl MapCamera {
    /// The camera of a fixed viewpoint for a map with these vertices.
    ///
    /// Frames the central 99 % of the vertices along each axis, so that a few stray points do not shrink the map.
    /// `camera_path` (poses of a camera) is kept in the picture and places [`Viewpoint::Inside`]; without it that
    /// view is placed at the centre of the map. `aspect` is width / height of the picture. A map without vertices gives a camera that looks at
    /// the origin.
    pub fn fixed(
        viewpoint: Viewpoint,
        positions: &[[f32; 3]],
        camera_path: Option<&Trajectory>,
        up: &Vector3<f64>,
        aspect: f64,
    ) -> Self {
        let plane = HorizontalPlane::of_up(up);
        let mut bounds = Bounds::robust(positions, &plane);
        if !positions.is_empty() {
            bounds.include(&plane, camera_path.map_or(&[][..], Trajectory::poses));
        }
        let name = viewpoint.name();
        match viewpoint {
            Viewpoint::Top => Self::above(name, &plane, &bounds, aspect),
            Viewpoint::ThreeQuarterFront => Self::around(name, &plane, &bounds, aspect, -55.0),
            Viewpoint::ThreeQuarterBack => Self::around(name, &plane, &bounds, aspect, 125.0),
            Viewpoint::Inside => Self::inside(name, &plane, &bounds, camera_path),
        }
    }

    /// Viewing direction, unit, world.
    pub fn forward(&self) -> Vector3<f64> {
        self.right.cross(&self.down)
    }

    fn above(name: &str, plane: &HorizontalPlane, bounds: &Bounds, aspect: f64) -> Self {
        let size = bounds.size();
        let height_m = 1.08 * size[1].max(size[0] / aspect);
        Self {
            name: name.to_owned(),
            position: bounds.world(plane, [0.5, 0.5, 1.0]) + plane.direction(0.0, 0.0, size[2] + 1.0),
            right: plane.direction(1.0, 0.0, 0.0),
            down: plane.direction(0.0, -1.0, 0.0),
            projection: Projection::Orthographic { height_m },
            back_faces: BackFaces::Cull,
        }
    }

    /// 38° above the horizon at an azimuth counted from the plane's first axis.
    fn around(name: &str, plane: &HorizontalPlane, bounds: &Bounds, aspect: f64, azimuth_deg: f64) -> Self {
        const ELEVATION_DEG: f64 = 38.0;
        // A small angle: weak perspective.
        const VERTICAL_ANGLE_DEG: f64 = 28.0;
        let (sa, ca) = azimuth_deg.to_radians().sin_cos();
        let (se, ce) = ELEVATION_DEG.to_radians().sin_cos();
        let right = plane.direction(-sa, ca, 0.0);
        let outwards = plane.direction(ce * ca, ce * sa, se);
        let down = plane.direction(se * ca, se * sa, -ce);
        let tangent = (0.5 * VERTICAL_ANGLE_DEG).to_radians().tan();
        let (center, distance) = bounds.framed(plane, [right, down, outwards], [tangent * aspect, tangent]);
        Self {
            name: name.to_owned(),
            position: center + outwards * (1.06 * distance),
            right,
            down,
            projection: Projection::Perspective { vertical_angle_deg: VERTICAL_ANGLE_DEG },
            back_faces: BackFaces::Cull,
        }
    }

    /// At the pose nearest to the mean camera position, upright, in the direction of that pose.
    fn inside(name: &str, plane: &HorizontalPlane, bounds: &Bounds, path: Option<&Trajectory>) -> Self {
        let poses = path.map_or(&[][..], Trajectory::poses);
        let count = poses.len().max(1) as f64;
        let mean: Vector3<f64> = poses.iter().map(|p| p.world_from_body.translation / count).sum();
        let nearest = poses.iter().min_by(|a, b| {
            let far = |p: &StampedPose| (p.world_from_body.translation - mean).norm_squared();
            far(a).total_cmp(&far(b))
        });
        let (position, looked) = match nearest {
            Some(p) => (p.world_from_body.translation, p.world_from_body.rotation * Vector3::z()),
            None => (bounds.world(plane, [0.5; 3]), plane.direction(0.0, 1.0, 0.0)),
        };
        let up = plane.direction(0.0, 0.0, 1.0);
        // Level the horizon unless the camera looks straight up or down.
        let right = looked.cross(&up).try_normalize(0.1).unwrap_or_else(|| plane.direction(1.0, 0.0, 0.0));
        let forward = looked.try_normalize(1e-9).unwrap_or_else(|| plane.direction(0.0, 1.0, 0.0));
        let forward = (forward - right * forward.dot(&right)).normalize();
        Self {
            name: name.to_owned(),
            position,
            right,
            down: forward.cross(&right),
            projection: Projection::Perspective { vertical_angle_deg: 68.0 },
            back_faces: BackFaces::Dim,
        }
    }
}

/// The box that holds nearly all vertices, in the axes of a plane.
struct Bounds {
    low: [f64; 3],
    high: [f64; 3],
    /// Vertices within, along right, away, up; thinned.
    inside: Vec<[f64; 3]>,
}

impl Bounds {
    fn robust(positions: &[[f32; 3]], plane: &HorizontalPlane) -> Self {
        // A hundred thousand samples are enough for a percentile.
        let stride = (positions.len() / 100_000).max(1);
        let finite = positions.iter().step_by(stride).filter(|p| p.iter().all(|v| v.is_finite()));
        let points: Vec<[f64; 3]> =
            finite.map(|p| plane.coordinates(&Vector3::from(p.map(f64::from)))).collect();
        let mut bounds = Self { low: [-1.0; 3], high: [1.0; 3], inside: Vec::new() };
        for axis in 0..3 {
            let mut values: Vec<f64> = points.iter().map(|p| p[axis]).collect();
            values.sort_unstable_by(f64::total_cmp);
            let Some(last) = values.len().checked_sub(1) else { continue };
            let trim = values.len() / 200;
            let (low, high) = (values[trim], values[last - trim]);
            // The trimmed part usually extends a little further.
            let air = (0.02 * (high - low)).max(1e-3);
            (bounds.low[axis], bounds.high[axis]) =
                ((low - air).max(values[0] - 1e-3), (high + air).min(values[last] + 1e-3));
        }
        let holds = |p: &[f64; 3]| (0..3).all(|i| (bounds.low[i]..=bounds.high[i]).contains(&p[i]));
        bounds.inside = points.into_iter().filter(holds).collect();
        bounds
    }

    /// Enlarges the box to contain the path if it is near.
    fn include(&mut self, plane: &HorizontalPlane, poses: &[StampedPose]) {
        // A path far from the map would make the map small; it is clipped by the picture instead.
        let reach = self.size().into_iter().fold(0.0, f64::max);
        let near = |p: &[f64; 3]| (0..3).all(|i| p[i] >= self.low[i] - reach && p[i] <= self.high[i] + reach);
        let stride = (poses.len() / 10_000).max(1);
        let places = poses.iter().step_by(stride).map(|p| plane.coordinates(&p.world_from_body.translation));
        let places: Vec<[f64; 3]> = places.filter(near).collect();
        for p in &places {
            for i in 0..3 {
                self.low[i] = self.low[i].min(p[i]);
                self.high[i] = self.high[i].max(p[i]);
            }
        }
        self.inside.extend(places);
    }

    /// The point to look at and the distance from which all vertices within lie in the picture.
    ///
    /// `axes` are the picture's right and down and the direction towards the eye; `tangents` those of the half angles.
    fn framed(
        &self,
        plane: &HorizontalPlane,
        [right, down, outwards]: [Vector3<f64>; 3],
        tangents: [f64; 2],
    ) -> (Vector3<f64>, f64) {
        let mut center = self.world(plane, [0.5; 3]);
        let mut distance = 1.0;
        // Each iteration centres the view of the last one; three are accurate to a pixel.
        for _ in 0..3 {
            let relative: Vec<[f64; 3]> = self
                .inside
                .iter()
                .map(|p| plane.direction(p[0], p[1], p[2]) - center)
                .map(|d| [d.dot(&right), d.dot(&down), d.dot(&outwards)])
                .collect();
            let needed = |p: &[f64; 3]| p[2] + (p[0].abs() / tangents[0]).max(p[1].abs() / tangents[1]);
            distance = relative.iter().map(needed).fold(1e-3, f64::max);
            for (axis, direction) in [right, down].iter().enumerate() {
                let slopes = relative.iter().map(|p| p[axis] / (distance - p[2]).max(1e-6));
                if let Some((low, high)) = crate::ticks::range_of(slopes) {
                    center += direction * (0.5 * (low + high) * distance);
                }
            }
        }
        // The last shift may have moved vertices slightly outside.
        let needed = |p: &[f64; 3]| {
            let d = plane.direction(p[0], p[1], p[2]) - center;
            d.dot(&outwards) + (d.dot(&right).abs() / tangents[0]).max(d.dot(&down).abs() / tangents[1])
        };
        (center, self.inside.iter().map(needed).fold(distance.min(1.0), f64::max))
    }

    fn size(&self) -> [f64; 3] {
        std::array::from_fn(|i| self.high[i] - self.low[i])
    }

    /// The point at shares 0…1 of each side.
    fn world(&self, plane: &HorizontalPlane, share: [f64; 3]) -> Vector3<f64> {
        let [right, away, up] =
            std::array::from_fn(|i| self.low[i] + share[i] * (self.high[i] - self.low[i]));
        plane.direction(right, away, up)
    }
}
