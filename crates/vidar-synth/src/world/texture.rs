//! Band-limited textures: a pyramid of box-filtered levels, read between levels by the ray's footprint.
//!
//! Because every level is a filtered copy of the one below (Williams, "Pyramidal parametrics", 1983), what a pixel
//! sees does not shimmer as the camera moves, however fine the pattern is.

/// One level of the pyramid.
#[derive(Clone, Debug)]
struct Level {
    width: usize,
    height: usize,
    /// Radiance, 0…65535 for 0…1.
    texels: Vec<u16>,
}

/// Radiance over a face's `(u, v)` rectangle.
#[derive(Clone, Debug)]
pub(crate) struct Texture {
    levels: Vec<Level>,
    texels_per_m: [f32; 2],
    /// Texels per metre in the mean of both directions.
    density: f32,
}

impl Texture {
    /// Samples `radiance(u, v)` (0…1) at the texel centres of a `size` (m) rectangle, texels about `texel_m` wide.
    pub(crate) fn bake(size: [f64; 2], texel_m: f64, mut row: impl FnMut(f64, &[f64], &mut [u16])) -> Self {
        let [width, height] = size.map(|s| (s / texel_m).ceil().clamp(1.0, 16_384.0) as usize);
        let (step_u, step_v) = (size[0] / width as f64, size[1] / height as f64);
        let us: Vec<f64> = (0..width).map(|x| (x as f64 + 0.5) * step_u).collect();
        let mut texels = vec![0; width * height];
        for (y, out) in texels.chunks_exact_mut(width).enumerate() {
            row((y as f64 + 0.5) * step_v, &us, out);
        }
        let mut levels = vec![Level { width, height, texels }];
        while let Some(last) = levels.last()
            && last.width.max(last.height) > 1
        {
            let next = last.halved();
            levels.push(next);
        }
        let texels_per_m = [1.0 / step_u as f32, 1.0 / step_v as f32];
        Self { levels, texels_per_m, density: (texels_per_m[0] * texels_per_m[1]).sqrt() }
    }

    /// Radiance at `uv` (m) averaged over about `footprint_m`.
    #[inline]
    pub(crate) fn read(&self, uv: [f64; 2], footprint_m: f32) -> f32 {
        let (u, v) = (uv[0] as f32 * self.texels_per_m[0], uv[1] as f32 * self.texels_per_m[1]);
        let last = (self.levels.len() - 1) as f32;
        let level = log2((footprint_m * self.density).max(1.0)).min(last);
        let fine = level as usize;
        let share = level - fine as f32;
        let a = self.levels[fine].read(u, v, fine);
        if share < 1e-3 || fine + 1 >= self.levels.len() {
            return a;
        }
        let b = self.levels[fine + 1].read(u, v, fine + 1);
        a + share * (b - a)
    }
}

/// Binary logarithm, straight between powers of two: within 0.09, and without a library call.
#[inline]
fn log2(x: f32) -> f32 {
    let bits = x.to_bits();
    let exponent = (bits >> 23) as i32 - 127;
    exponent as f32 + (bits & 0x7F_FFFF) as f32 * (1.0 / 8_388_608.0)
}

impl Level {
    /// Bilinear value at `(u, v)` in texels of the finest level, `halvings` levels below this one.
    #[inline]
    fn read(&self, u: f32, v: f32, halvings: usize) -> f32 {
        let (w, h) = (self.width, self.height);
        let scale = 1.0 / (1_u32 << halvings) as f32;
        let x = (u * scale - 0.5).clamp(0.0, (w - 1) as f32);
        let y = (v * scale - 0.5).clamp(0.0, (h - 1) as f32);
        let (x0, y0) = (x as usize, y as usize);
        let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
        let (ax, ay) = (x - x0 as f32, y - y0 as f32);
        let at = |x: usize, y: usize| f32::from(self.texels[y * w + x]);
        let top = at(x0, y0) + ax * (at(x1, y0) - at(x0, y0));
        let bottom = at(x0, y1) + ax * (at(x1, y1) - at(x0, y1));
        (top + ay * (bottom - top)) * (1.0 / 65_535.0)
    }

    /// Every 2 × 2 texels averaged into one; an odd last row or column is repeated.
    fn halved(&self) -> Self {
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let mut texels = Vec::with_capacity(width * height);
        for y in 0..height {
            let rows = [2 * y, (2 * y + 1).min(self.height - 1)];
            for x in 0..width {
                let columns = [2 * x, (2 * x + 1).min(self.width - 1)];
                let mut sum = 0_u32;
                for r in rows {
                    for c in columns {
                        sum += u32::from(self.texels[r * self.width + c]);
                    }
                }
                texels.push(((sum + 2) / 4) as u16);
            }
        }
        Self { width, height, texels }
    }
}
