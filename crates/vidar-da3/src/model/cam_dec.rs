//! The camera decoder, `cam_dec` (DA3, camera head): camera tokens become pose encodings.
//!
//! Two ReLU layers `backbone.{0,2}`, then position `fc_t`, quaternion `fc_qvec` (xyzw, of any length) and fields of view
//! `fc_fov.0` (ReLU). Shapes: tokens `[views, 2D]`, codes `[views, 9]`.

use crate::error::Da3Error;
use crate::run::Run;
use crate::weights::Scope;
use vidar_nn::{Epilogue, Linear, Precision};

/// The decoder's layers.
pub(crate) struct CameraDecoder {
    backbone_0: Linear,
    backbone_2: Linear,
    fc_t: Linear,
    fc_qvec: Linear,
    fc_fov: Linear,
}

impl CameraDecoder {
    pub fn load(scope: &Scope, width: usize) -> Result<Self, Da3Error> {
        Ok(Self {
            backbone_0: scope.linear("backbone.0", width, width)?,
            backbone_2: scope.linear("backbone.2", width, width)?,
            fc_t: scope.linear("fc_t", width, 3)?,
            fc_qvec: scope.linear("fc_qvec", width, 4)?,
            fc_fov: scope.linear("fc_fov.0", width, 2)?,
        })
    }

    /// Pose encodings of the views' camera tokens. Always in `f32`, as the official code does it.
    pub fn run(&self, run: &Run<'_>, tokens: &[f32]) -> Vec<[f64; 9]> {
        let compute = run.backbone.at(Precision::F32);
        let width = self.backbone_0.in_features();
        let views = tokens.len() / width;
        let layer = |layer: &Linear, input: &[f32], end: Epilogue<'_>| {
            let mut out = vec![0.0; views * layer.out_features()];
            layer.apply(&compute, input, views, &mut out, end);
            out
        };
        let hidden = layer(&self.backbone_0, tokens, Epilogue::Relu);
        let hidden = layer(&self.backbone_2, &hidden, Epilogue::Relu);
        let position = layer(&self.fc_t, &hidden, Epilogue::None);
        let quaternion = layer(&self.fc_qvec, &hidden, Epilogue::None);
        let fov = layer(&self.fc_fov, &hidden, Epilogue::Relu);
        let code = |v: usize| -> [f32; 9] {
            let (t, q, f) = (&position[3 * v..], &quaternion[4 * v..], &fov[2 * v..]);
            [t[0], t[1], t[2], q[0], q[1], q[2], q[3], f[0], f[1]]
        };
        (0..views)
            .map(|v| {
                run.show("pose_enc", v, &[9], &code(v));
                code(v).map(f64::from)
            })
            .collect()
    }
}
