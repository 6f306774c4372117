//! The text of the shader of a product.

use super::{Form, Input, Output, TileSizes};
use crate::kernel::fill;
use crate::weight::Storage;
use std::fmt::Write as _;

pub(super) fn source(form: Form) -> String {
    let TileSizes { rows, columns, inner, own_rows, own_columns } = form.tile.sizes();
    let (gx, gy) = (columns / own_columns, rows / own_rows);
    let (mut zero, mut products, mut stores) = (String::new(), String::new(), String::new());
    for j in 0..own_columns {
        let _ = writeln!(products, "      let w{j} = ws[(tx + {}u) * STRIDE + k];", j * gx);
    }
    for i in 0..own_rows {
        let _ = writeln!(products, "      let x{i} = xs[(ty + {}u) * STRIDE + k];", i * gy);
        for j in 0..own_columns {
            let _ = writeln!(zero, "  var s{i}_{j} = 0.0;");
            let _ = writeln!(
                products,
                "      s{i}_{j} = fma(x{i}.w, w{j}.w, fma(x{i}.z, w{j}.z, fma(x{i}.y, w{j}.y, fma(x{i}.x, w{j}.x, s{i}_{j}))));"
            );
            let row = format!("first_row + ty + {}u", i * gy);
            let _ = match form.output {
                Output::Gated if j % 2 == 0 => writeln!(
                    stores,
                    "  store_gated({row}, first_column + tx + {}u, s{i}_{j}, s{i}_{});",
                    j * gx,
                    j + 1
                ),
                Output::Gated => Ok(()),
                _ => writeln!(stores, "  store({row}, first_column + tx + {}u, s{i}_{j});", j * gx),
            };
        }
    }
    let is_gated = form.output == Output::Gated;
    fill(
        include_str!("../../shaders/matmul.wgsl"),
        &[
            ("BM", rows.to_string()),
            ("BN", columns.to_string()),
            ("BK", inner.to_string()),
            ("TM", own_rows.to_string()),
            ("TN", own_columns.to_string()),
            ("GX", gx.to_string()),
            ("GY", gy.to_string()),
            ("XS", (rows * (inner + 1)).to_string()),
            ("WS", (columns * (inner + 1)).to_string()),
            ("THREADS", (gx * gy).to_string()),
            ("WTYPE", if form.storage == Storage::F32 { "vec4<f32>" } else { "vec2<u32>" }.to_owned()),
            ("LOAD_X", load_x(form.input).to_owned()),
            ("LOAD_W", load_w(form.storage).to_owned()),
            ("ERF_NOTE", "Φ by Abramowitz and Stegun 7.1.26: absolute error below 1.5e-7.".to_owned()),
            ("STORE", store(form.output).to_owned()),
            ("STORE_GATED", if is_gated { STORE_GATED } else { "" }.to_owned()),
            ("ZERO", zero),
            ("PRODUCTS", products),
            ("STORES", stores),
        ],
    )
}

/// Where four channels under a tap of a 3×3 kernel lie; zero outside of the map.
macro_rules! three {
    () => {
        "  if k >= p.inner { return vec4<f32>(); }
  let channels = p.in_stride;
  let tap = k / channels;
  let pixel = min(row, p.rows - 1u);
  let r = i32(pixel / p.out_columns * p.step + tap / 3u) - 1;
  let c = i32(pixel % p.out_columns * p.step + tap % 3u) - 1;
  if r < 0 || c < 0 || r >= i32(p.map_rows) || c >= i32(p.map_columns) { return vec4<f32>(); }
  let at = p.in_at + (u32(r) * p.map_columns + u32(c)) * channels + k % channels;
"
    };
}

fn load_x(input: Input) -> &'static str {
    match input {
        Input::Flat => {
            "  if k >= p.inner { return vec4<f32>(); }
  return x[p.in_at + min(row, p.rows - 1u) * p.in_stride + k];"
        }
        Input::Three => concat!(three!(), "  return x[at];"),
        Input::ThreeRelu => concat!(three!(), "  return max(x[at], vec4<f32>());"),
    }
}

fn load_w(storage: Storage) -> &'static str {
    match storage {
        Storage::F32 => "  return w[at];",
        Storage::Bf16 => {
            "  let v = w[at];
  return bitcast<vec4<f32>>(vec4<u32>(v.x << 16u, v.x & 0xffff0000u, v.y << 16u, v.y & 0xffff0000u));"
        }
        Storage::F16 => {
            "  let v = w[at];
  return vec4<f32>(unpack2x16float(v.x), unpack2x16float(v.y));"
        }
    }
}

fn store(output: Output) -> &'static str {
    match output {
        Output::Store | Output::Gated => "  y[p.out_at + row * p.out_stride + column] = v;",
        Output::Gelu => "  y[p.out_at + row * p.out_stride + column] = gelu(v);",
        Output::Relu => "  y[p.out_at + row * p.out_stride + column] = max(v, 0.0);",
        Output::Accumulate => "  y[p.out_at + row * p.out_stride + column] += v;",
        Output::Scaled => "  y[p.out_at + row * p.out_stride + column] += extra[column] * v;",
        Output::Add => {
            "  y[p.out_at + row * p.out_stride + column] = v + extra[p.extra_at + row * p.out_stride + column];"
        }
        Output::Spread => {
            "  let channels = p.out_stride;
  let tap = column / channels;
  let out_row = (row / p.out_columns) * p.step + tap / p.step;
  let out_column = (row % p.out_columns) * p.step + tap % p.step;
  y[p.out_at + (out_row * p.out_columns * p.step + out_column) * channels + column % channels] = v;"
        }
    }
}

const STORE_GATED: &str = "fn store_gated(row: u32, column: u32, gate: f32, value: f32) {
  let place = column / 32u * 16u + column % 16u;
  if row >= p.rows || column + 16u >= p.columns || place >= p.out_stride { return; }
  y[p.out_at + row * p.out_stride + place] = silu(gate + bias[column]) * (value + bias[column + 16u]);
}";
