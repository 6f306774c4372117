//! Resampling of maps and embedding of their grid.

use super::convolution::MapShape;
use super::groups;
use crate::buffer::Buffer;
use crate::device::Gpu;
use crate::error::GpuError;
use crate::kernel::{Kernel, fill};
use crate::recorder::Recorder;

/// An embedding of a pixel grid: the first half of the channels depends on the column, the second on the row.
pub struct Grid {
    by_column: Buffer,
    by_row: Buffer,
    shape: MapShape,
}

impl Grid {
    /// Puts tables `[columns, channels / 2]` and `[rows, channels / 2]` on the device.
    ///
    /// # Errors
    /// Errors of [`Gpu::buffer`].
    ///
    /// # Panics
    /// When the lengths do not fit.
    pub fn new(gpu: &Gpu, by_column: &[f32], by_row: &[f32], shape: MapShape) -> Result<Self, GpuError> {
        let half = shape.channels / 2;
        assert!(shape.channels.is_multiple_of(4), "an embedded map has channels by four");
        assert!(by_column.len() == shape.columns * half && by_row.len() == shape.rows * half, "{shape:?}");
        Ok(Self {
            by_column: gpu.upload("embedding by column", by_column)?,
            by_row: gpu.upload("embedding by row", by_row)?,
            shape,
        })
    }
}

/// Enlarges a map to `rows` × `columns`, corner pixels' centres on corner pixels' centres, and adds an embedding where there
/// is one.
///
/// # Errors
/// When the device refuses the kernel.
///
/// # Panics
/// When sizes do not fit or the channels are no multiple of 4.
pub fn resample(
    recorder: &mut Recorder,
    (x, shape): (&Buffer, MapShape),
    (rows, columns): (usize, usize),
    grid: Option<&Grid>,
    out: &Buffer,
) -> Result<MapShape, GpuError> {
    let to = MapShape { rows, columns, channels: shape.channels };
    assert!(shape.channels.is_multiple_of(4) && !shape.is_nothing(), "{shape:?} to be resampled");
    assert!(shape.len() <= x.len() && to.len() <= out.len(), "{shape:?} to {to:?}");
    assert!(grid.is_none_or(|g| g.shape == to), "embedding of a map");
    let step = |from: usize, to: usize| if to > 1 { (from - 1) as f32 / (to - 1) as f32 } else { 0.0 };
    let words = [
        (to.len() / 4) as u32,
        (shape.channels / 4) as u32,
        shape.rows as u32,
        shape.columns as u32,
        columns as u32,
        step(shape.rows, rows).to_bits(),
        step(shape.columns, columns).to_bits(),
    ];
    let tables = grid.map_or([x, x], |g| [&g.by_column, &g.by_row]);
    let kernel = resample_kernel(grid.map(|_| is_split_by_four(shape.channels)));
    recorder.dispatch(&kernel, &[x, tables[0], tables[1]], out, &words, groups(to.len() / 4, 256))?;
    Ok(to)
}

/// Adds an embedding to a map in place.
///
/// # Errors
/// When the device refuses the kernel.
///
/// # Panics
/// When the map is smaller.
pub fn embed(recorder: &mut Recorder, grid: &Grid, map: &Buffer) -> Result<(), GpuError> {
    let shape = grid.shape;
    assert!(shape.len() <= map.len(), "{shape:?} to be embedded");
    let count = shape.len() / 4;
    let words = [count, shape.channels / 4, shape.columns].map(|n| n as u32);
    let kernel = embed_kernel(is_split_by_four(shape.channels));
    recorder.dispatch(&kernel, &[&grid.by_column, &grid.by_row], map, &words, groups(count, 256))
}

impl MapShape {
    fn is_nothing(self) -> bool {
        self.len() == 0
    }
}

/// Whether no vector of four lies on the border between the two halves.
fn is_split_by_four(channels: usize) -> bool {
    channels.is_multiple_of(8)
}

const BY_FOUR: &str = "fn embedding(row: u32, column: u32, c: u32) -> vec4<f32> {
  let half = p.channels / 2u;
  if c < half { return by_column[column * half + c]; }
  return by_row[row * half + c - half];
}";

const BY_ONE: &str = "fn channel(row: u32, column: u32, c: u32) -> f32 {
  let half = p.channels * 2u;
  if c < half { return by_column[column * half + c]; }
  return by_row[row * half + c - half];
}
fn embedding(row: u32, column: u32, c: u32) -> vec4<f32> {
  return vec4<f32>(channel(row, column, 4u * c), channel(row, column, 4u * c + 1u), channel(row, column, 4u * c + 2u), channel(row, column, 4u * c + 3u));
}";

fn table(by_four: bool) -> [(&'static str, String); 2] {
    let (table, function) = if by_four { ("vec4<f32>", BY_FOUR) } else { ("f32", BY_ONE) };
    [("TABLE", table.to_owned()), ("FUNCTION", function.to_owned())]
}

fn resample_kernel(embedding: Option<bool>) -> Kernel {
    Kernel::new(format!("resample {embedding:?}"), 3, move || {
        let [table, function] = table(embedding.unwrap_or(true));
        let (embed, function) = match embedding {
            Some(_) => (" + embedding(row, column, c)", function),
            None => ("", ("FUNCTION", String::new())),
        };
        fill(include_str!("../shaders/resample.wgsl"), &[table, function, ("EMBED", embed.to_owned())])
    })
}

fn embed_kernel(by_four: bool) -> Kernel {
    Kernel::new(format!("embed {by_four}"), 2, move || {
        fill(include_str!("../shaders/embed.wgsl"), &table(by_four))
    })
}

pub(crate) fn every_kernel() -> Vec<Kernel> {
    let mut all: Vec<Kernel> = [None, Some(true), Some(false)].into_iter().map(resample_kernel).collect();
    all.extend([true, false].into_iter().map(embed_kernel));
    all
}
