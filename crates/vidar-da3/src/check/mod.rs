//! Checking a model against reference files.
//!
//! A reference is a safetensors file of named tensors, described by an entry of the `manifest.json` beside it: which
//! network (`model`, or a whole `config`), `views`, `H`, `W`, what the input is, and `kwargs`. Weights are synthetic
//! ([`crate::weights::synthetic`]) unless a checkpoint is given. Every tensor of the file that a run computes is compared in
//! the order of computation, so that the first failing row names the first layer that differs.
//!
//! Names: `input` `[S,3,H,W]`; `patch_embed`, `tokens_in`, `blockII`, `featK`, `camtokK`, `pose_enc`, `cam_enc_pose9`,
//! `cam_enc_tokens`; `head.*` with channels first; `out.*`; for nested models `any.*`, `metric.*`; for inference with
//! given cameras `api_true.*` (aligned) and `api_false.*`. A suffix `.sN` keeps every N-th pixel, `.everyN` every N-th
//! token.

mod collect;
mod compare;
mod golden;
mod posed;
mod report;

pub use golden::Golden;
pub use report::{CheckReport, CheckResult, Measure, Row, Tolerances};

use crate::da3::{Da3, Da3Options};
use crate::error::Da3Error;
use crate::infer::{InferOptions, NetOutput};
use crate::model::backbone::{Pixels, ReferenceStrategy};
use crate::pose::{self, NetCameras};
use crate::run::Hooks;
use collect::Collector;
use compare::Comparison;
use golden::Kind;
use std::path::Path;

/// Checks one reference file; `weights` is a model to open instead of synthetic weights.
pub fn check_file(
    file: &Path,
    weights: Option<&Path>,
    options: &Da3Options,
) -> Result<CheckReport, Da3Error> {
    let golden = Golden::open(file)?;
    let model = match weights {
        Some(path) => Da3::open(path, options)?,
        None => Da3::synthetic_of(golden.config()?, options)?,
    };
    check(&golden, &model, &Hooks::default())
}

/// Checks an open model against a reference.
pub fn check(golden: &Golden, model: &Da3, hooks: &Hooks<'_>) -> Result<CheckReport, Da3Error> {
    let tolerances = Tolerances::of(model);
    let pixels = golden.pixels()?;
    let view = Pixels::new(&pixels, golden.views, golden.rows, golden.columns)?;
    let mut comparison = Comparison::new(golden, tolerances);
    let given = match golden.kind {
        Kind::Posed => Some(posed::net_cameras(golden, &mut comparison)?),
        Kind::Free | Kind::Nested => None,
    };
    let cameras = given
        .as_ref()
        .map(|g| NetCameras { camera_from_world: &g.camera_from_world, intrinsics: &g.intrinsics });
    let mut options = InferOptions {
        reference: golden.strategy,
        wants_rays: golden.has("out.ray"),
        ..InferOptions::default()
    };
    let forward = |options: &InferOptions| -> Result<(NetOutput, Collector), Da3Error> {
        let collector = Collector::new(golden);
        let hooks = Hooks { trace: Some(&collector), ..*hooks };
        let output = model.forward(&view, cameras, options, &hooks)?;
        Ok((output, collector))
    };
    let (mut output, mut collector) = forward(&options)?;
    if let Some(expected) = golden.reference()? {
        let found = output.reference;
        comparison.reference(expected, found, golden.strategy);
        if expected != found {
            // Two views have equal scores and rounding decides: go on with the choice of the reference.
            options.reference = ReferenceStrategy::View(expected);
            (output, collector) = forward(&options)?;
        }
    }
    comparison.traced(&collector)?;
    comparison.output(&output)?;
    if golden.kind == Kind::Posed {
        posed::check_interface(golden, model, hooks, &mut comparison)?;
    }
    Ok(comparison.report(model))
}

/// The first three rows of a rigid transform, as reference files store it.
fn three_rows(matrix: &nalgebra::Matrix4<f64>) -> Vec<f64> {
    let (rotation, translation) = pose::parts(matrix);
    (0..3).flat_map(|r| [rotation[(r, 0)], rotation[(r, 1)], rotation[(r, 2)], translation[r]]).collect()
}
