//! Evaluates stereo view by view on recordings with sensor depth: completeness, accuracy, and calibration of the
//! confidence.
//!
//! ```sh
//! cargo run --release -p vidar-stereo --example evaluate_views -- RECORDING [FLAG VALUE]...
//! ```
//!
//! Of the recording: `--camera-model`, `--depth-intrinsics`, `--color-from-depth` as for `vidar run`.
//! Which keyframes: `--min-translation-m`, `--min-rotation-deg`, `--first N`, `--last N` (of the keyframes).
//! Settings of stereo: `--set key=value`. Errors added to the input: `--jitter-deg`, `--jitter-m` (noise of each pose),
//! `--lag-ms` (delay of the poses), `--focal-ratio`, `--center-px`, `--seed N`.
//! `--stages yes` adds processor time by stage; exact with `RAYON_NUM_THREADS=1`. `--csv FILE` writes a sample of the features with the error, for `fit_confidence`.

#![allow(clippy::print_stdout, reason = "its output is what the example is for")]

mod input;
mod score;
mod stages;

use input::{Request, ViewSet};
use score::Score;
use stages::Stages;
use std::error::Error;
use std::sync::Arc;
use vidar_core::{ChunkId, ChunkViews};
use vidar_stereo::{StereoConfig, StereoModel};

/// Keyframes of a chunk and of its context on each side, as the program's defaults are.
const CHUNK: usize = 16;
const CONTEXT: usize = 8;

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let request = Request::parse(&args)?;
    let config: StereoConfig = toml::from_str(&request.settings.join("\n"))?;
    let recording = ViewSet::open(&request)?;
    let model = StereoModel::new(config)?;
    let stages = Arc::new(Stages::default());
    if request.stages {
        tracing::subscriber::set_global_default(Arc::clone(&stages))?;
    }
    let mut score = Score::default();
    let count = recording.keyframes.len();
    let evaluated = request.first.min(count)..request.last.min(count);
    let views = recording.views(&request)?;
    let (mut omitted, mut secs) = (0, 0.0);
    for (number, start) in evaluated.clone().step_by(CHUNK).enumerate() {
        let core = start..(start + CHUNK).min(evaluated.end);
        let window = start.saturating_sub(CONTEXT)..(core.end + CONTEXT).min(count);
        let chunk = ChunkViews { id: ChunkId(number as u32), views: views[window.clone()].to_vec() };
        let references: Vec<usize> = core.map(|i| i - window.start).collect();
        let before = processor_secs();
        let (output, features) = model.predict_with_features(&chunk, &references, &|_| false)?;
        secs += processor_secs() - before;
        omitted += output.omitted.len();
        for (view, features) in output.prediction.views.iter().zip(&features) {
            let truth = recording.sensor_depth(view)?;
            score.add(view, features, &truth);
        }
    }
    println!("{}: {} keyframes, {omitted} without parallax", request.name(), evaluated.len());
    println!("  processor time {:.0} ms a view", 1e3 * secs / evaluated.len().max(1) as f64);
    if request.stages {
        stages.print(evaluated.len());
    }
    score.print();
    if let Some(path) = &request.csv {
        std::fs::write(path, score.csv())?;
    }
    Ok(())
}

/// Processor time of this process so far, all threads, seconds; zero where the system does not report it.
fn processor_secs() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // After the name in parentheses; user and system time are the 14th and 15th field, in hundredths of a second.
    let fields: Vec<f64> = stat
        .rsplit(')')
        .next()
        .map_or_else(Vec::new, |rest| rest.split_whitespace().map(|f| f.parse().unwrap_or(0.0)).collect());
    fields.get(11..13).map_or(0.0, |times| times.iter().sum::<f64>() / 100.0)
}
