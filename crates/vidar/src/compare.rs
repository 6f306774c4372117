//! `vidar compare`: finished runs on one page: numbers side by side, cameras linked, distances of their surfaces in colour.

mod distance;
mod load;
mod page;
mod placement;

use crate::error::Error;
use distance::SurfaceDistance;
use load::StoredRun;
use placement::Placed;
use serde_json::{Value, json};
use std::path::PathBuf;

/// Runs on one page: beyond four the panes are too small to see anything in.
pub const MAX_RUNS: usize = 4;

/// What to compare and where to write it.
#[derive(Clone, Debug)]
pub struct CompareRequest {
    /// Run folders; the first is what the others are compared with.
    pub runs: Vec<PathBuf>,
    /// The page.
    pub page: PathBuf,
    /// Replace a page that exists.
    pub force: bool,
}

/// A comparison that was written.
#[derive(Clone, Debug)]
pub struct Comparison {
    /// Names, scores, placements and distances: `vidar.compare/1`.
    pub json: Value,
    /// The same in a few lines for people.
    pub lines: Vec<(String, String)>,
}

/// Reads the runs, places them in the world of the first, measures the distances of their surfaces and writes the page.
///
/// # Errors
/// Too few or too many runs, a folder that is not of a run, a page that exists, or one that cannot be written.
pub fn compare(request: &CompareRequest) -> Result<Comparison, Error> {
    if !(2..=MAX_RUNS).contains(&request.runs.len()) {
        return Err(Error::Usage {
            what: format!("{} runs: a page compares 2 to {MAX_RUNS}", request.runs.len()),
            hint: "name the folders of two runs or more: vidar compare runs/a runs/b".into(),
        });
    }
    if request.page.exists() && !request.force {
        return Err(Error::Usage {
            what: format!("{} exists", request.page.display()),
            hint: "choose another name with -o, or replace it with --force".into(),
        });
    }
    let names = load::names(&request.runs);
    let mut runs = request
        .runs
        .iter()
        .zip(names)
        .map(|(folder, name)| StoredRun::read(folder, name))
        .collect::<Result<Vec<_>, _>>()?;
    let placed = placement::place(&mut runs)?;
    let distances = distance::measure(&runs)?;
    let html = page::html(&runs, &placed, &distances)?;
    if let Some(parent) = request.page.parent().filter(|p| !p.as_os_str().is_empty()) {
        std::fs::create_dir_all(parent).map_err(|e| Error::io("create", parent, e))?;
    }
    vidar_export::atomic::write_file_atomically(&request.page, html.as_bytes())?;
    Ok(Comparison {
        json: as_json(request, html.len(), &runs, &placed, &distances),
        lines: in_lines(request, &runs, &placed, &distances),
    })
}

fn as_json(
    request: &CompareRequest,
    bytes: usize,
    runs: &[StoredRun],
    placed: &[Placed],
    distances: &[SurfaceDistance],
) -> Value {
    let one = |(i, run): (usize, &StoredRun)| {
        let distance = distances.iter().find(|d| d.run == i);
        json!({
            "name": run.name,
            "folder": run.folder.display().to_string(),
            "is_metric": run.metrics.scale.is_metric,
            "scale_sigma": run.metrics.scale.sigma,
            "verdict": run.metrics.verdict,
            "scores": run.metrics.scores,
            "placement": placed[i].json(),
            "distance": distance.map(SurfaceDistance::json),
        })
    };
    json!({
        "schema": "vidar.compare/1",
        "page": request.page.display().to_string(),
        "bytes": bytes,
        "runs": runs.iter().enumerate().map(one).collect::<Vec<_>>(),
        "settings": load::differing_settings(runs).into_iter().collect::<serde_json::Map<_, _>>(),
    })
}

fn in_lines(
    request: &CompareRequest,
    runs: &[StoredRun],
    placed: &[Placed],
    distances: &[SurfaceDistance],
) -> Vec<(String, String)> {
    let mut lines: Vec<(String, String)> = runs.iter().map(|r| (r.name.clone(), r.verdict_line())).collect();
    lines.extend((1..runs.len()).map(|i| (format!("{} placed", runs[i].name), placed[i].words())));
    lines.extend(
        distances.iter().map(|d| (format!("{} to {}", runs[d.run].name, runs[0].name), d.words(runs))),
    );
    lines.push(("look at it".into(), request.page.display().to_string()));
    lines
}
