//! Solves the reference's Sim(3) pose graph of a file, or the coupled graph of 500 keyframes, and prints times and answers as
//! JSON: the Rust half of `bench/graph_vs_reference.py`.
//!
//! Usage: `solve_graphs chain FILE ROUNDS` or `solve_graphs coupled ROUNDS`. The file holds f64 tensors: `chain` `[n, 13]`, the similarities from chunk k + 1 to k as
//! scale, row-major rotation, translation, and `loops` `[m, 15]`: chunks a and b, and the similarity from a to b.

#![allow(clippy::print_stdout, clippy::expect_used)] // its output is its purpose; made-up graphs may stop at a surprise

use nalgebra::{Matrix3, Vector3};
use safetensors::SafeTensors;
use std::error::Error;
use std::time::Instant;
use vidar_align::coupled::{CoupledConfig, solve};
use vidar_align::streaming::{LoopConstraint, PoseGraphConfig, optimise_chain};
use vidar_core::{Sim3, So3};

#[path = "../benches/graph/mod.rs"]
mod graph;

fn rows(file: &SafeTensors<'_>, name: &str, width: usize) -> Result<Vec<Vec<f64>>, Box<dyn Error>> {
    let bytes = file.tensor(name)?.data().chunks_exact(8);
    let values: Vec<f64> = bytes.filter_map(|b| Some(f64::from_le_bytes(b.try_into().ok()?))).collect();
    Ok(values.chunks_exact(width).map(<[f64]>::to_vec).collect())
}

fn similarity(row: &[f64]) -> Result<Sim3, Box<dyn Error>> {
    let rotation = Matrix3::from_row_slice(&row[1..10]);
    let rotation = So3::from_matrix(&rotation).ok_or("not a rotation")?;
    Ok(Sim3::new(rotation, Vector3::new(row[10], row[11], row[12]), row[0]).ok_or("not a similarity")?)
}

/// The reference's scheme on the file's graph.
fn solve_chain(path: &str, rounds: usize) -> Result<serde_json::Value, Box<dyn Error>> {
    let bytes = std::fs::read(path)?;
    let file = SafeTensors::deserialize(&bytes)?;
    let chain: Vec<Sim3> =
        rows(&file, "chain", 13)?.iter().map(|r| similarity(r)).collect::<Result<_, _>>()?;
    let mut loops = Vec::new();
    for row in rows(&file, "loops", 15)? {
        loops.push(LoopConstraint {
            a: row[0] as usize,
            b: row[1] as usize,
            b_from_a: similarity(&row[2..])?,
        });
    }
    let mut seconds = Vec::new();
    let mut outcome = optimise_chain(&chain, &loops, &PoseGraphConfig::default())?;
    for _ in 0..rounds {
        let start = Instant::now();
        outcome = optimise_chain(&chain, &loops, &PoseGraphConfig::default())?;
        seconds.push(start.elapsed().as_secs_f64());
    }
    let last = outcome.steps.iter().rev().find(|s| s.is_accepted).ok_or("no step was taken")?;
    let numbers = |s: &Sim3| -> Vec<f64> {
        let turn = s.rotation.matrix().transpose();
        [s.scale].iter().chain(turn.as_slice()).chain(s.translation.as_slice()).copied().collect()
    };
    let relatives: Vec<Vec<f64>> = outcome.previous_from_next.iter().map(numbers).collect();
    let (iterations, cost) = (outcome.steps.len(), last.cost_after);
    Ok(
        serde_json::json!({ "seconds": seconds, "iterations": iterations, "cost": cost, "relatives": relatives }),
    )
}

/// VIDAR's own graph, made here.
fn solve_coupled(rounds: usize) -> Result<serde_json::Value, Box<dyn Error>> {
    let (state, factors) = graph::graph();
    let config = CoupledConfig { max_iterations: 4, tolerance: 0.0, ..Default::default() };
    let mut iterations = solve(&state, &factors, &config)?.iterations;
    let mut seconds = Vec::new();
    for _ in 0..rounds {
        let start = Instant::now();
        iterations = solve(&state, &factors, &config)?.iterations;
        seconds.push(start.elapsed().as_secs_f64());
    }
    Ok(serde_json::json!({ "seconds": seconds, "iterations": iterations }))
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let report = match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["chain", path, rounds] => solve_chain(path, rounds.parse()?)?,
        ["coupled", rounds] => solve_coupled(rounds.parse()?)?,
        _ => return Err("solve_graphs chain FILE ROUNDS | coupled ROUNDS".into()),
    };
    println!("{report}");
    Ok(())
}
