//! Multi-head attention in memory that grows with the number of tokens, not with its square.

use super::groups;
use super::norm::Norm;
use crate::buffer::Buffer;
use crate::device::Gpu;
use crate::error::GpuError;
use crate::kernel::{Kernel, fill};
use crate::recorder::Recorder;
use std::fmt::Write as _;

/// Channels of a head that workgroup memory has room for.
const MOST_CHANNELS: usize = 128;

/// Cosines and sines of positions; token t uses position t modulo their number.
pub struct Rotation {
    turns: Buffer,
    positions: usize,
}

impl Rotation {
    /// Puts tables `[positions, 2, head_dim / 4]` of both halves of a head on the device.
    ///
    /// # Errors
    /// [`GpuError::Shape`] when the head dimension is no multiple of 16; errors of [`Gpu::buffer`].
    ///
    /// # Panics
    /// When the lengths do not fit.
    pub fn new(gpu: &Gpu, cos: &[f32], sin: &[f32], head_dim: usize) -> Result<Self, GpuError> {
        assert!(cos.len() == sin.len() && cos.len().is_multiple_of(head_dim / 2), "rotation tables");
        if !head_dim.is_multiple_of(16) {
            return Err(GpuError::Shape {
                layer: "rotation of queries and keys".into(),
                what: "channels of a head",
                found: head_dim,
                expected: "a multiple of 16",
            });
        }
        let positions = cos.len() / (head_dim / 2);
        let rows = cos.chunks_exact(head_dim / 2).zip(sin.chunks_exact(head_dim / 2));
        let turns: Vec<f32> = rows.flat_map(|(cos, sin)| [cos, sin].concat()).collect();
        Ok(Self { turns: gpu.upload("rotation", &turns)?, positions })
    }
}

fn checked(heads: usize, head_dim: usize) -> Result<(), GpuError> {
    if head_dim.is_multiple_of(4) && (4..=MOST_CHANNELS).contains(&head_dim) {
        return Ok(());
    }
    Err(GpuError::Shape {
        layer: format!("attention of {heads} heads"),
        what: "channels of a head",
        found: head_dim,
        expected: "a multiple of 4, at most 128",
    })
}

/// Normalises and rotates the queries and keys of `tokens` tokens in `qkv`, `[tokens, 3, heads, head_dim]`.
///
/// # Errors
/// [`GpuError::Shape`] for a head that the shader does not cover; when the device refuses the kernel.
///
/// # Panics
/// When lengths do not fit.
pub fn prepare_heads(
    recorder: &mut Recorder,
    qkv: &Buffer,
    tokens: usize,
    (heads, head_dim): (usize, usize),
    norms: Option<(&Norm, &Norm)>,
    rotation: Option<&Rotation>,
) -> Result<(), GpuError> {
    checked(heads, head_dim)?;
    assert!(qkv.len() >= tokens * 3 * heads * head_dim, "queries, keys and values");
    let kernel = match (norms, rotation) {
        (None, None) => return Ok(()),
        _ => prepare_kernel(head_dim, norms.is_some(), rotation.is_some()),
    };
    let turns = rotation.map(|r| &r.turns);
    // Something must be bound where the kernel reads nothing.
    let (spare, own);
    let any = match (norms, turns) {
        (Some((q, _)), _) => q.parts().0,
        (None, Some(turns)) => turns,
        (None, None) => {
            own = recorder.gpu().buffer("nothing", 4)?;
            &own
        }
    };
    spare = any;
    let (q, k) = match norms {
        Some((q, k)) => (q.parts(), k.parts()),
        None => ((spare, spare, 0.0), (spare, spare, 0.0)),
    };
    let items = tokens * 2 * heads;
    let positions = rotation.map_or(1, |r| r.positions);
    let words = [items as u32, heads as u32, positions as u32, q.2.to_bits(), k.2.to_bits()];
    let reads = [q.0, q.1, k.0, k.1, turns.unwrap_or(spare)];
    recorder.dispatch(&kernel, &reads, qkv, &words, groups(items, 64))
}

fn prepare_kernel(head_dim: usize, has_norm: bool, has_turn: bool) -> Kernel {
    let name = format!("prepare {head_dim} norm {has_norm} turn {has_turn}");
    Kernel::new(name, 5, move || prepare_source(head_dim / 4, has_norm, has_turn))
}

fn prepare_source(d: usize, has_norm: bool, has_turn: bool) -> String {
    let [mut load, mut norm, mut turn, mut store] = [const { String::new() }; 4];
    let all = |text: &mut String, line: &dyn Fn(usize) -> String| {
        for j in 0..d {
            let _ = writeln!(text, "  {}", line(j));
        }
    };
    all(&mut load, &|j| format!("var t{j} = qkv[at + {j}u];"));
    if has_norm {
        let sum = |term: &dyn Fn(usize) -> String| (0..d).map(term).collect::<Vec<_>>().join(" + ");
        let _ = writeln!(norm, "  let sums = {};", sum(&|j| format!("t{j}")));
        let _ = writeln!(norm, "  let mean = (sums.x + sums.y + sums.z + sums.w) / {}.0;", 4 * d);
        all(&mut norm, &|j| format!("t{j} -= mean;"));
        let _ = writeln!(norm, "  let squares = {};", sum(&|j| format!("t{j} * t{j}")));
        let _ = writeln!(
            norm,
            "  let scale = 1.0 / sqrt((squares.x + squares.y + squares.z + squares.w) / {}.0 + select(p.q_eps, p.k_eps, is_key));",
            4 * d
        );
        all(&mut norm, &|j| {
            format!(
                "t{j} = fma(t{j} * scale, select(q_weight[{j}u], k_weight[{j}u], is_key), select(q_bias[{j}u], k_bias[{j}u], is_key));"
            )
        });
    }
    if has_turn {
        let quarter = d / 4;
        let _ = writeln!(turn, "  let turn = token % p.positions * D;");
        for half in 0..2 {
            for j in 0..quarter {
                let (a, b) = (half * 2 * quarter + j, half * 2 * quarter + quarter + j);
                let cos = half * quarter + j;
                let sin = 2 * quarter + cos;
                let _ =
                    writeln!(turn, "  let c{cos} = turns[turn + {cos}u]; let s{cos} = turns[turn + {sin}u];");
                let _ = writeln!(turn, "  let a{cos} = t{a} * c{cos} - t{b} * s{cos};");
                let _ = writeln!(turn, "  t{b} = t{b} * c{cos} + t{a} * s{cos};");
                let _ = writeln!(turn, "  t{a} = a{cos};");
            }
        }
    }
    all(&mut store, &|j| format!("qkv[at + {j}u] = t{j};"));
    fill(
        include_str!("../shaders/prepare.wgsl"),
        &[("D", d.to_string()), ("LOAD", load), ("NORM", norm), ("TURN", turn), ("STORE", store)],
    )
}

/// Which queries meet which keys, in tokens of `[tokens, 3, heads, head_dim]`.
#[derive(Debug, Clone, Copy)]
pub struct AttendSpec {
    /// Heads.
    pub heads: usize,
    /// Channels of a head; scores are divided by its square root.
    pub head_dim: usize,
    /// First query, and queries of a sequence.
    pub queries: (usize, usize),
    /// First key, and keys of a sequence.
    pub keys: (usize, usize),
    /// Token of the output that the first query's answer becomes.
    pub out: usize,
    /// Sequences; from one to the next, queries, keys and outputs move on by their numbers.
    pub sequences: usize,
}

/// Attention; `out` is `[tokens, heads, head_dim]`.
///
/// # Errors
/// [`GpuError::Shape`] for a head that the shader does not cover; when the device refuses the kernel.
///
/// # Panics
/// When ranges do not fit or there are no keys.
pub fn attend(
    recorder: &mut Recorder,
    qkv: &Buffer,
    out: &Buffer,
    spec: &AttendSpec,
) -> Result<(), GpuError> {
    let AttendSpec { heads, head_dim, queries, keys, out: to, sequences } = *spec;
    checked(heads, head_dim)?;
    if sequences == 0 || queries.1 == 0 {
        return Ok(());
    }
    assert!(keys.1 > 0, "attention to no keys");
    let width = heads * head_dim;
    let (last_query, last_key) = (queries.0 + sequences * queries.1, keys.0 + sequences * keys.1);
    let last_answer = to + sequences * queries.1;
    assert!(
        qkv.len() >= last_query.max(last_key) * 3 * width && out.len() >= last_answer * width,
        "{spec:?}"
    );
    let factor = std::f32::consts::LOG2_E / (head_dim as f32).sqrt();
    let [count, first, keys, first_key, heads, to] =
        [queries.1, queries.0, keys.1, keys.0, heads, to].map(|n| n as u32);
    let words = [count, first, keys, first_key, heads, to, factor.to_bits()];
    let groups = [queries.1.div_ceil(64) as u32, heads, sequences as u32];
    recorder.dispatch(&attend_kernel(head_dim), &[qkv], out, &words, groups)
}

fn attend_kernel(head_dim: usize) -> Kernel {
    Kernel::new(format!("attend {head_dim}"), 1, move || attend_source(head_dim / 4))
}

/// Keys whose scores are made before the maximum is updated.
const TOGETHER: usize = 8;

fn attend_source(d: usize) -> String {
    // 8 KiB of keys and values at 64 channels, 16 KiB at 128.
    let keys = 16;
    let [mut query, mut scores, mut shrink, mut add, mut store] = [const { String::new() }; 5];
    let line = |text: &mut String, words: String| {
        let _ = writeln!(text, "  {words}");
    };
    for j in 0..d {
        line(&mut query, format!("let q{j} = qkv[start + {j}u] * p.factor;"));
        line(&mut query, format!("var o{j} = vec4<f32>();"));
        line(&mut shrink, format!("      o{j} *= shrink;"));
        line(&mut store, format!("y[to + {j}u] = o{j} * share;"));
    }
    for n in 0..TOGETHER {
        line(&mut scores, format!("    let k{n} = (b + {n}u) * D;"));
        line(&mut scores, format!("    var a{n} = q0 * ks[k{n}];"));
        for j in 1..d {
            line(&mut scores, format!("    a{n} = fma(q{j}, ks[k{n} + {j}u], a{n});"));
        }
        line(
            &mut scores,
            format!(
                "    let e{n} = select(-3.0e38, a{n}.x + a{n}.y + a{n}.z + a{n}.w, block + b + {n}u < p.keys);"
            ),
        );
        line(&mut add, format!("    let f{n} = exp2(e{n} - top);"));
        line(&mut add, format!("    total += f{n};"));
        for j in 0..d {
            line(&mut add, format!("    o{j} = fma(vec4<f32>(f{n}), vs[k{n} + {j}u], o{j});"));
        }
    }
    let highest = (1..TOGETHER).fold("e0".to_owned(), |text, n| format!("max({text}, e{n})"));
    fill(
        include_str!("../shaders/attention.wgsl"),
        &[
            ("D", d.to_string()),
            ("KEYS", keys.to_string()),
            ("WORDS", (keys * d).to_string()),
            ("QUERY", query),
            ("SCORES", scores),
            ("HIGHEST", highest),
            ("SHRINK", shrink),
            ("ADD", add),
            ("STORE", store),
        ],
    )
}

pub(crate) fn every_kernel() -> Vec<Kernel> {
    let mut all: Vec<Kernel> = (4..=MOST_CHANNELS).step_by(4).map(attend_kernel).collect();
    for head_dim in [16, 32, 64, 96, 128] {
        for (norm, turn) in [(true, true), (true, false), (false, true)] {
            all.push(prepare_kernel(head_dim, norm, turn));
        }
    }
    all
}
