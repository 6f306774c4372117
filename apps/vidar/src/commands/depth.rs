//! `vidar depth`.

use super::model::{accepted, precision};
use crate::build::{self, usage};
use crate::model_args::{DepthArgs, MethodArg, RefViewArg, ResolutionArg};
use crate::{Context, Outcome, print, progress};
use serde_json::json;
use vidar::da3::preprocess::{PreprocessConfig, ResizeMethod};
use vidar::da3::{Da3Options, InferOptions, Precision, ReferenceStrategy};
use vidar::depth::{DepthOutcome, DepthRequest, Resolution, parse_formats};
use vidar::export_formats::official::SceneOptions;
use vidar::models::{self, ModelChoice};
use vidar::{Error, ExitStatus};

/// Depth, confidence, cameras and a cloud from images.
pub fn depth(args: &DepthArgs, context: &Context) -> Outcome {
    let request = request(args, context)?;
    if args.dry_run {
        return dry_run(&request, context);
    }
    let outcome = vidar::depth::run(&request, &progress::events(&context.cli), &context.cancel)?;
    if context.cli.json {
        let mut value = json!({ "schema": "vidar.depth-run/1" });
        if let (Some(object), Ok(serde_json::Value::Object(fields))) =
            (value.as_object_mut(), serde_json::to_value(&outcome))
        {
            object.extend(fields);
        }
        print::json(&value);
    } else {
        print::warnings(&outcome.warnings);
        print_outcome(&outcome);
    }
    Ok(ExitStatus::Done)
}

fn print_outcome(outcome: &DepthOutcome) {
    let (width, height) = outcome.size;
    let at = |name: &str| outcome.folder.join(name).display().to_string();
    let mut rows = vec![
        ("depth", format!("{} views, {width}x{height} px", outcome.views)),
        ("unit", format!("{:?}: {}", outcome.unit, outcome.unit_reason)),
        ("predictions", at("predictions.json")),
    ];
    for name in ["points.ply", "scene.glb"] {
        if outcome.artifacts.iter().any(|a| a == name) {
            rows.push(("cloud", at(name)));
        }
    }
    rows.push(("files", format!("{} in {}", outcome.artifacts.len(), outcome.folder.display())));
    let all = print::seconds(outcome.seconds);
    rows.push(("took", format!("{all}, the network {}", print::seconds(outcome.network_secs))));
    print::pairs(rows);
}

fn request(args: &DepthArgs, context: &Context) -> Result<DepthRequest, Error> {
    let model = match &args.model_dir {
        Some(path) => ModelChoice::Folder(path.clone()),
        None => ModelChoice::named(&args.model)?,
    };
    if !(0.0..=100.0).contains(&args.conf_percentile) {
        return Err(usage(
            format!("--conf-percentile {}", args.conf_percentile),
            "give a number from 0 to 100",
        ));
    }
    if let Some(focal) = args.focal.filter(|f| !(f.is_finite() && *f > 0.0)) {
        return Err(usage(format!("--focal {focal}"), "give the focal length in pixels of the images"));
    }
    let infer = infer_options(args, &model);
    let name = args.inputs.first().map(|path| vidar::input::name_of(path)).unwrap_or_default();
    Ok(DepthRequest {
        inputs: args.inputs.clone(),
        model,
        accepted: accepted(&args.licence),
        store: models::store(context.cli.offline)?,
        da3: Da3Options {
            precision: precision(args.precision),
            // The dense head stays in 32 bits, as in the official program.
            head_precision: Some(Precision::F32),
            device: args.device,
            ..Da3Options::default()
        },
        infer,
        poses: args.poses.clone(),
        focal_px: args.focal,
        formats: parse_formats(&args.format)?,
        resolution: match args.resolution {
            ResolutionArg::Processed => Resolution::Processed,
            ResolutionArg::Input => Resolution::Input,
        },
        scene: SceneOptions {
            confidence_percentile: args.conf_percentile,
            most_points: args.max_points,
            ..SceneOptions::default()
        },
        place: build::place(&args.output, &format!("depth-{name}")),
        command: context.command.clone(),
    })
}

fn infer_options(args: &DepthArgs, model: &ModelChoice) -> InferOptions {
    let process_size_px = args.process_res.unwrap_or_else(|| models::process_size_px(model));
    let method = match args.method {
        MethodArg::UpperBoundResize => ResizeMethod::UpperBoundResize,
        MethodArg::UpperBoundCrop => ResizeMethod::UpperBoundCrop,
        MethodArg::LowerBoundResize => ResizeMethod::LowerBoundResize,
        MethodArg::LowerBoundCrop => ResizeMethod::LowerBoundCrop,
    };
    InferOptions {
        preprocess: PreprocessConfig { process_size_px, method },
        reference: match args.ref_view {
            RefViewArg::SaddleBalanced => ReferenceStrategy::SaddleBalanced,
            RefViewArg::SaddleSimRange => ReferenceStrategy::SaddleSimRange,
            RefViewArg::First => ReferenceStrategy::First,
            RefViewArg::Middle => ReferenceStrategy::Middle,
        },
        use_ray_pose: args.use_ray_pose,
        align_to_given: !args.keep_scale,
        compat: args.compat,
        ..InferOptions::default()
    }
}

fn dry_run(request: &DepthRequest, context: &Context) -> Outcome {
    let plan = vidar::depth::plan(request)?;
    if context.cli.json {
        let lines: serde_json::Map<String, serde_json::Value> =
            plan.lines().into_iter().map(|(k, v)| (k.replace(' ', "_"), v.into())).collect();
        print::json(
            &json!({ "schema": "vidar.plan/1", "plan": lines, "memory": plan.memory, "device": plan.device }),
        );
    } else {
        print::pairs(plan.lines());
        print::warnings(&plan.warnings);
    }
    Ok(ExitStatus::Done)
}
