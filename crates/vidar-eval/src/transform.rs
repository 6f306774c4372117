//! Transforms in reports.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use vidar_core::{Se3, Sim3, So3};

/// A similarity `a_from_b` as numbers: `p_in_a = scale · R · p_in_b + translation`. Scale 1 for a rigid motion.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TransformRecord {
    /// Unit quaternion of R, scalar last, w ≥ 0.
    pub rotation_xyzw: [f64; 4],
    /// Translation, metres of *a*.
    pub translation_m: [f64; 3],
    /// Metres of *a* per unit of *b*.
    pub scale: f64,
}

impl From<Sim3> for TransformRecord {
    fn from(t: Sim3) -> Self {
        Self {
            rotation_xyzw: t.rotation.quaternion_xyzw(),
            translation_m: t.translation.into(),
            scale: t.scale,
        }
    }
}

impl From<Se3> for TransformRecord {
    fn from(t: Se3) -> Self {
        Sim3::from_se3(&t).into()
    }
}

impl TransformRecord {
    /// The similarity; `None` when the numbers are not one (a record read from a damaged file).
    pub fn to_sim3(&self) -> Option<Sim3> {
        let [x, y, z, w] = self.rotation_xyzw;
        let rotation = So3::from_quaternion(x, y, z, w)?;
        Sim3::new(rotation, Vector3::from(self.translation_m), self.scale).filter(Sim3::is_finite)
    }

    /// Its rotation and translation, without the scale; `None` when the numbers are not a transform.
    pub fn to_se3(&self) -> Option<Se3> {
        self.to_sim3().map(|t| Se3::new(t.rotation, t.translation))
    }
}
