//! `vidar bench`.

use crate::args::{BenchArgs, BenchDataset};
use crate::build::{self, usage};
use crate::{Context, Outcome, print, progress};
use serde_json::json;
use vidar::align::CouplingMode;
use vidar::bench::{BenchKind, BenchRequest, SyntheticBench};
use vidar::models::geometry::source;
use vidar::synth::SynthConfig;
use vidar::{Error, Layered};

/// The paper's tables.
pub fn bench(args: &BenchArgs, context: &Context) -> Outcome {
    let mut layered = build::layered(&args.config, None)?;
    build::apply_source_flags(&mut layered, args.geometry.as_deref(), args.model_dir.as_deref())?;
    let kind = match args.dataset {
        BenchDataset::Euroc => BenchKind::Euroc,
        BenchDataset::Tum => BenchKind::Tum,
        BenchDataset::TumVi => BenchKind::TumVi,
        BenchDataset::SevenScenes => BenchKind::SevenScenes,
    };
    if args.synthetic && kind != BenchKind::Euroc {
        return Err(usage("--synthetic renders EuRoC's camera and IMU", "`vidar bench euroc --synthetic`"));
    }
    let request = BenchRequest {
        kind,
        root: args.root.clone(),
        synthetic: synthetic(args)?,
        sequences: args.sequences.clone(),
        modes: modes(args, &layered)?,
        trajectories: !args.no_trajectories,
        layered,
        out: args.output.clone(),
        command: context.command.clone(),
    };
    if args.ablation {
        return ablation(&request, args.seeds, context);
    }
    let outcome = vidar::bench::bench(&request, &progress::events(&context.cli), &context.cancel)?;
    if context.cli.json {
        print::json(&json!({
            "schema": vidar::bench::BENCH_SCHEMA, "folder": outcome.folder, "sequences": outcome.sequences,
            "runs": outcome.rows, "odometry": outcome.odometry, "exit": outcome.status as i32,
        }));
    } else {
        print::data(&outcome.markdown);
        let report = outcome.folder.join("report.html").display().to_string();
        print::talk(format!("tables, runs and figures: {}", vidar::core::printable(&report)));
    }
    Ok(outcome.status)
}

/// What each measurement brings to each coupling.
fn ablation(request: &BenchRequest, seeds: u64, context: &Context) -> Outcome {
    let events = progress::events(&context.cli);
    let outcome = vidar::bench::ablation::ablation(request, seeds, &events, &context.cancel)?;
    if context.cli.json {
        print::json(&json!({
            "schema": vidar::bench::ablation::ABLATION_SCHEMA, "folder": outcome.folder, "rows": outcome.rows,
            "exit": outcome.status as i32,
        }));
    } else {
        print::data(&outcome.markdown);
        print::talk(format!("every case: {}", outcome.folder.join("ablation.json").display()));
    }
    Ok(outcome.status)
}

fn synthetic(args: &BenchArgs) -> Result<Option<SyntheticBench>, Error> {
    if !args.synthetic {
        return Ok(None);
    }
    let world = match &args.world_config {
        Some(path) => super::synth::world_file(path)?,
        None => SynthConfig::euroc(),
    };
    world.validate()?;
    Ok(Some(SyntheticBench { world }))
}

/// The couplings of --modes; else those of the paper's tables that the source supports.
fn modes(args: &BenchArgs, layered: &Layered) -> Result<Vec<CouplingMode>, Error> {
    if !args.modes.is_empty() {
        return args.modes.iter().map(|m| mode(m)).collect();
    }
    let is_stereo = source(&layered.build()?)?.is_by_stereo();
    Ok(match is_stereo {
        true => vec![CouplingMode::PoseConditioned, CouplingMode::GroundTruth, CouplingMode::Coupled],
        false => vec![
            CouplingMode::PoseFree,
            CouplingMode::PoseConditioned,
            CouplingMode::GroundTruth,
            CouplingMode::Hybrid,
            CouplingMode::Coupled,
        ],
    })
}

fn mode(name: &str) -> Result<CouplingMode, Error> {
    CouplingMode::ALL.into_iter().find(|m| m.name() == name).ok_or_else(|| {
        let known: Vec<&str> = CouplingMode::ALL.iter().map(|m| m.name()).collect();
        usage(format!("--modes {name:?} is not a coupling"), format!("couplings: {}", known.join(", ")))
    })
}
