//! The camera encoder, `cam_enc` (DA3, pose conditioning): given cameras become tokens.
//!
//! `pose_branch.{fc1,fc2}` lift a pose encoding of nine numbers to D channels; `token_norm`, the blocks `trunk.I` over the
//! sequence of views (no rotation, no query-key norm), `trunk_norm`. Shapes: codes `[views, 9]`, tokens `[views, D]`.

use super::backbone::{Block, BlockScratch, BlockShape};
use crate::config::{CameraEncoderConfig, Ffn};
use crate::error::Da3Error;
use crate::run::Run;
use crate::weights::Scope;
use vidar_nn::{Epilogue, LayerNorm, Linear, Precision};

const EPS: f32 = 1e-5;

/// The encoder's layers.
pub(crate) struct CameraEncoder {
    fc1: Linear,
    fc2: Linear,
    token_norm: LayerNorm,
    trunk: Vec<Block>,
    trunk_norm: LayerNorm,
}

impl CameraEncoder {
    pub fn load(scope: &Scope, config: &CameraEncoderConfig, dim: usize) -> Result<Self, Da3Error> {
        let branch = scope.at("pose_branch");
        let ffn = Ffn::Mlp { hidden: config.mlp_ratio * dim };
        let shape = BlockShape { dim, heads: config.heads, ffn, has_qk_norm: false, eps: EPS };
        let trunk = (0..config.depth).map(|i| Block::load(&scope.at(&format!("trunk.{i}")), shape));
        Ok(Self {
            fc1: branch.linear("fc1", 9, dim / 2)?,
            fc2: branch.linear("fc2", dim / 2, dim)?,
            token_norm: scope.norm("token_norm", dim, EPS)?,
            trunk: trunk.collect::<Result<_, _>>()?,
            trunk_norm: scope.norm("trunk_norm", dim, EPS)?,
        })
    }

    /// Tokens of the views' pose encodings. Always in `f32`, as the official code does it.
    pub fn run(&self, run: &Run<'_>, codes: &[[f64; 9]]) -> Vec<f32> {
        let compute = run.backbone.at(Precision::F32);
        let input: Vec<f32> = codes.iter().flatten().map(|v| *v as f32).collect();
        let (views, dim) = (codes.len(), self.fc2.out_features());
        let mut hidden = vec![0.0; views * self.fc1.out_features()];
        self.fc1.apply(&compute, &input, views, &mut hidden, Epilogue::Gelu);
        let mut tokens = vec![0.0; views * dim];
        self.fc2.apply(&compute, &hidden, views, &mut tokens, Epilogue::None);
        self.token_norm.apply_in_place(&compute, &mut tokens);
        let mut scratch = BlockScratch::default();
        for block in &self.trunk {
            block.run(&compute.into(), &mut tokens, 1, None, &mut scratch);
        }
        self.trunk_norm.apply_in_place(&compute, &mut tokens);
        for (view, (code, token)) in input.chunks_exact(9).zip(tokens.chunks_exact(dim)).enumerate() {
            run.show("cam_enc_pose9", view, &[9], code);
            run.show("cam_enc_tokens", view, &[dim], token);
        }
        tokens
    }
}
