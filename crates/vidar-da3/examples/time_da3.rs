//! Times a network with synthetic weights: `time_da3 da3-small --views 4 --size 378x504 --precision bf16 --runs 3`.
//!
//! One line of JSON a run: wall and CPU seconds, and the process's largest memory so far. `bench/da3_vs_torch.py` drives it
//! in turn with the official code: with `--serve` it answers one run a line of standard input.

use std::io::{BufRead, Write};
use std::time::Instant;
use vidar_da3::weights::synthetic::image_u8;
use vidar_da3::{Da3, Da3Options, Hooks, InferOptions, Pixels, Variant, preprocess::normalise};

type Fallible<T> = Result<T, Box<dyn std::error::Error>>;

struct Arguments {
    variant: Variant,
    views: usize,
    rows: usize,
    columns: usize,
    runs: usize,
    serve: bool,
    options: Da3Options,
    infer: InferOptions,
}

fn arguments() -> Fallible<Arguments> {
    let mut words = std::env::args().skip(1);
    let name = words.next().ok_or("which network? (da3-small, …)")?;
    let variant = Variant::from_name(&name).ok_or(format!("unknown network {name}"))?;
    let mut found = Arguments {
        variant,
        views: 1,
        rows: 378,
        columns: 504,
        runs: 3,
        serve: false,
        options: Da3Options::default(),
        infer: InferOptions::default(),
    };
    while let Some(word) = words.next() {
        let mut value = || words.next().ok_or(format!("{word} needs a value"));
        match word.as_str() {
            "--views" => found.views = value()?.parse()?,
            "--size" => {
                let text = value()?;
                let (rows, columns) = text.split_once('x').ok_or("--size ROWSxCOLUMNS")?;
                (found.rows, found.columns) = (rows.parse()?, columns.parse()?);
            }
            "--precision" => found.options.precision = value()?.parse()?,
            "--head-precision" => found.options.head_precision = Some(value()?.parse()?),
            "--exact-blocks" => found.options.exact_blocks = Some(value()?.parse()?),
            "--device" => found.options.device = value()?.parse()?,
            "--isa" => found.options.isa = Some(value()?.parse()?),
            "--runs" => found.runs = value()?.parse()?,
            "--rays" => found.infer.wants_rays = true,
            "--serve" => found.serve = true,
            other => return Err(format!("unknown option {other}").into()),
        }
    }
    Ok(found)
}

/// User and system seconds of this process; nothing where `/proc` is missing.
fn cpu_seconds() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/self/stat").ok()?;
    let fields: Vec<&str> = text.rsplit_once(") ")?.1.split(' ').collect();
    let ticks = fields.get(11)?.parse::<f64>().ok()? + fields.get(12)?.parse::<f64>().ok()?;
    Some(ticks / 100.0)
}

/// Largest memory of this process so far, kilobytes.
fn peak_kilobytes() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = text.lines().find(|l| l.starts_with("VmHWM:"))?;
    line.split_whitespace().nth(1)?.parse().ok()
}

/// Most bytes held on a device so far.
fn device_peak(model: &Da3) -> Option<u64> {
    #[cfg(feature = "gpu")]
    return model.gpu().map(|gpu| gpu.peak_bytes());
    #[cfg(not(feature = "gpu"))]
    return model.device_name().map(|_| 0);
}

fn main() -> Fallible<()> {
    let arguments = arguments()?;
    let model = Da3::synthetic(arguments.variant, &arguments.options)?;
    let (views, rows, columns) = (arguments.views, arguments.rows, arguments.columns);
    let pictures = (0..views).map(|seed| normalise(&image_u8(seed as u64 + 1, columns, rows)));
    let data: Vec<f32> = pictures.flatten().collect();
    let pixels = Pixels::new(&data, views, rows, columns)?;
    let mut out = std::io::stdout();
    let weights = peak_kilobytes();
    let mut run = || -> Fallible<()> {
        let (cpu, start) = (cpu_seconds(), Instant::now());
        let answer = model.forward(&pixels, None, &arguments.infer, &Hooks::default())?;
        let wall = start.elapsed().as_secs_f64();
        let cpu = cpu_seconds().zip(cpu).map(|(after, before)| after - before);
        let line = serde_json::json!({
            "model": arguments.variant.name(), "views": views, "rows": rows, "columns": columns,
            "arithmetic": model.describe_compute(), "device_peak_bytes": device_peak(&model),
            "wall_s": wall, "cpu_s": cpu, "peak_kb": peak_kilobytes(), "weights_kb": weights,
            "depth_mean": answer.depth.iter().map(|d| f64::from(*d)).sum::<f64>() / answer.depth.len() as f64,
        });
        writeln!(out, "{line}")?;
        Ok(out.flush()?)
    };
    if arguments.serve {
        for line in std::io::stdin().lock().lines() {
            line?;
            run()?;
        }
        return Ok(());
    }
    (0..arguments.runs).try_for_each(|_| run())
}
