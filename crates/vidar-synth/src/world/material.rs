//! What surfaces are made of: albedo (0…1) as a function of place, with structure at every scale and no repetition.

use super::noise::{band, cell, hash, mix, octaves, step, value_noise};

/// A kind of surface.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Plaster,
    Brick,
    Concrete,
    Planks,
    Tiles,
    CeilingPanels,
    Cardboard,
    Poster,
    Books,
    Fabric,
    Metal,
    Hazard,
    Door,
    Window,
    Board,
    /// Nearly uniform paint, as real rooms have and stereo dislikes.
    Plain,
    /// Uniform albedo; only the light on it varies.
    Uniform,
}

/// A surface: its kind, its own random numbers, its mean brightness, and the size (m) of what it covers.
#[derive(Clone, Copy, Debug)]
pub(super) struct Material {
    pub kind: Kind,
    pub seed: u32,
    pub tone: f32,
}

/// Something painted onto or set into a face: a rectangle with a material of its own and a frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct Decal {
    pub corner: [f32; 2],
    pub size: [f32; 2],
    pub material: Material,
    /// Width of the frame, m; 0 for none.
    pub frame: f32,
    /// Light of its own, as a factor on its albedo: 0 for none, 1 about as bright as lit by the room.
    pub glow: f32,
}

/// A face's material with everything on it; later decals cover earlier ones.
#[derive(Clone, Debug)]
pub(super) struct Surface {
    pub base: Material,
    pub decals: Vec<Decal>,
}

impl Surface {
    /// Albedo at `(u, v)` of a face of `size`, for texels of `texel` metres.
    pub(super) fn albedo(&self, u: f32, v: f32, size: [f32; 2], texel: f32) -> f32 {
        for decal in self.decals.iter().rev() {
            let (x, y) = (u - decal.corner[0], v - decal.corner[1]);
            let [w, h] = decal.size;
            if x >= 0.0 && y >= 0.0 && x < w && y < h {
                let edge = x.min(y).min(w - x).min(h - y);
                let inside = decal.material.albedo(x, y, decal.size, texel);
                if decal.frame <= 0.0 {
                    return inside;
                }
                let wood = 0.18 + 0.25 * cell(3, 1, decal.material.seed);
                let grain = wood + 0.05 * octaves(x, y, 0.05, texel, 0.6, decal.material.seed);
                return mix(grain, inside, step(decal.frame, edge, texel));
            }
        }
        self.base.albedo(u, v, size, texel)
    }

    /// Light of its own at `(u, v)`, as a factor on the albedo.
    pub(super) fn glow(&self, u: f32, v: f32) -> f32 {
        let inside = |d: &&Decal| {
            let (x, y) = (u - d.corner[0], v - d.corner[1]);
            x >= d.frame && y >= d.frame && x < d.size[0] - d.frame && y < d.size[1] - d.frame
        };
        self.decals.iter().rev().find(inside).map_or(0.0, |d| d.glow)
    }
}

impl Material {
    /// The same for all that is cut from one stock: of one kind and brightness, whatever its grain.
    pub(super) fn number(&self) -> u32 {
        hash(self.kind as i32, self.tone.to_bits() as i32, 0x5EED)
    }

    /// Albedo at `(u, v)` (m) of a face of `size` (m).
    pub(super) fn albedo(&self, u: f32, v: f32, size: [f32; 2], texel: f32) -> f32 {
        let s = self.seed;
        let tone = self.tone;
        let rough = |wavelength: f32, gain: f32| octaves(u, v, wavelength, texel, gain, s);
        let value = match self.kind {
            Kind::Plaster => {
                let dirt = rough(1.7, 0.62);
                let specks = speckle(u, v, 0.035, texel, s ^ 11);
                let grain = octaves(u, v, 0.09, texel, 0.75, s ^ 29);
                tone + 0.15 * dirt + 0.07 * grain - 0.20 * specks - 0.10 * crack(u, v, 0.9, texel, s ^ 5)
            }
            Kind::Uniform => tone,
            Kind::Plain => tone + 0.012 * rough(0.8, 0.5),
            Kind::Brick => brick(u, v, texel, s, tone),
            Kind::Concrete => {
                let pores = speckle(u, v, 0.05, texel, s ^ 3);
                tone + 0.20 * rough(2.3, 0.68) - 0.22 * pores - 0.2 * crack(u, v, 1.4, texel, s ^ 9)
            }
            Kind::Planks => planks(u, v, texel, s, tone),
            Kind::Tiles => tiles(u, v, 0.33, 0.006, texel, s, tone, 0.14),
            Kind::CeilingPanels => {
                let holes = speckle(u, v, 0.03, texel, s ^ 21);
                tiles(u, v, 0.6, 0.012, texel, s, tone, 0.05) - 0.18 * holes
            }
            Kind::Cardboard => cardboard(u, v, size, texel, s, tone),
            Kind::Poster => poster(u, v, size, texel, s),
            Kind::Books => books(u, v, texel, s),
            Kind::Fabric => {
                let weave = (u * 700.0).sin() * (v * 700.0).sin() * if texel < 0.003 { 0.05 } else { 0.0 };
                let stripe_w = 0.05 + 0.08 * cell(1, 7, s);
                let stripe = cell((u / stripe_w).floor() as i32, 2, s);
                let motif = speckle(u, v, 0.09, texel, s ^ 13);
                tone + 0.25 * (stripe - 0.5) + weave + 0.10 * rough(0.3, 0.7) + 0.2 * motif
            }
            Kind::Metal => {
                let brushed = octaves(u * 0.15, v, 0.05, texel, 0.75, s ^ 17);
                let rust = (rough(0.5, 0.6) - 0.15).max(0.0);
                tone + 0.10 * brushed - 0.5 * rust + 0.06 * rough(0.04, 0.6)
            }
            Kind::Hazard => {
                let stripe = ((u + v) / 0.16).rem_euclid(1.0) * 0.16;
                mix(0.12, 0.75, band(0.0, 0.08, stripe, texel)) + 0.08 * rough(0.3, 0.7)
            }
            Kind::Door => door(u, v, size, texel, s, tone),
            Kind::Window => {
                let bar = |x: f32, w: f32| band(0.5 * w - 0.03, 0.5 * w + 0.03, x, texel);
                let view = 0.62 + 0.25 * octaves(u, v, 0.9, texel, 0.55, s) + 0.15 * (v / size[1] - 0.5);
                let frame = bar(u, size[0]).max(bar(v, size[1]));
                mix(view, 0.85, frame)
            }
            Kind::Board => board(u, v, size, texel, s),
        };
        value.clamp(0.03, 0.95)
    }
}

/// Scattered round spots of various sizes, one or none per cell of `pitch`; 0…1.
fn speckle(u: f32, v: f32, pitch: f32, texel: f32, seed: u32) -> f32 {
    let (cx, cy) = ((u / pitch).floor() as i32, (v / pitch).floor() as i32);
    let amount = cell(cx, cy, seed ^ 0xA5);
    if amount < 0.45 {
        return 0.0;
    }
    let radius = pitch * (0.08 + 0.3 * cell(cx, cy, seed ^ 0x77));
    // Anywhere in the cell where the whole spot fits.
    let free = pitch - 2.0 * radius;
    let x = cx as f32 * pitch + radius + free * cell(cx, cy, seed ^ 0x11);
    let y = cy as f32 * pitch + radius + free * cell(cx, cy, seed ^ 0x22);
    // A spot smaller than a texel keeps its share of the texel.
    let share = (radius / texel).min(1.0);
    share * share * amount * (1.0 - step(radius, length(u - x, v - y), texel))
}

/// Thin dark lines where noise crosses zero.
fn crack(u: f32, v: f32, wavelength: f32, texel: f32, seed: u32) -> f32 {
    let n = octaves(u, v, wavelength, texel.max(0.02), 0.5, seed);
    // Slope of the noise is about 2/wavelength, which turns a width in metres into one in values.
    let width = (0.004_f32).max(texel) * 3.0 / wavelength;
    let strength = (0.004 / texel).min(1.0);
    let patch = step(0.1, value_noise(u / (2.0 * wavelength), v / (2.0 * wavelength), seed ^ 1), 0.3);
    strength * patch * (1.0 - (n.abs() / width).min(1.0))
}

fn brick(u: f32, v: f32, texel: f32, seed: u32, tone: f32) -> f32 {
    let (length, course, joint) = (0.25, 0.08, 0.008);
    let row = (v / course).floor();
    let shift = if row as i32 % 2 == 0 { 0.0 } else { 0.5 * length };
    let column = ((u + shift) / length).floor();
    let (x, y) = (u + shift - column * length, v - row * course);
    let wear = 0.004 * octaves(u, v, 0.06, texel, 0.6, seed ^ 4);
    let inside = band(joint + wear, length - joint + wear, x, texel) * band(joint + wear, course, y, texel);
    let own = cell(column as i32, row as i32, seed);
    let face =
        tone + 0.24 * (own - 0.5) + 0.14 * octaves(u, v, 0.12, texel, 0.7, seed ^ hash(row as i32, 1, 2));
    mix(tone + 0.22 + 0.08 * octaves(u, v, 0.05, texel, 0.7, seed ^ 8), face, inside)
}

fn planks(u: f32, v: f32, texel: f32, seed: u32, tone: f32) -> f32 {
    let width = 0.14;
    let row = (v / width).floor();
    let r = row as i32;
    let length = 1.1 + 0.9 * cell(r, 5, seed);
    let along = u + 3.0 * cell(r, 6, seed);
    let plank = (along / length).floor();
    let (x, y) = (along - plank * length, v - row * width);
    let own = hash(plank as i32, r, seed);
    let grain =
        octaves(along * 0.12, v + 0.01 * value_noise(along * 3.0, v * 9.0, own), 0.03, texel, 0.75, own);
    let knots = speckle(u, v, 0.13, texel, seed ^ 31);
    let gap = 1.0 - band(0.004, width - 0.001, y, texel) * band(0.004, length - 0.001, x, texel);
    let cloud = octaves(u, v, 1.3, texel, 0.6, seed ^ 77);
    let body =
        tone + 0.30 * ((own & 0xFFFF) as f32 / 65_535.0 - 0.5) + 0.13 * grain - 0.12 * knots + 0.08 * cloud;
    mix(body, 0.08, 0.85 * gap * (0.005 / texel).min(1.0))
}

#[allow(clippy::too_many_arguments)] // a private pattern's parameters, all plain numbers
fn tiles(u: f32, v: f32, pitch: f32, joint: f32, texel: f32, seed: u32, tone: f32, variety: f32) -> f32 {
    let (cx, cy) = ((u / pitch).floor(), (v / pitch).floor());
    let (x, y) = (u - cx * pitch, v - cy * pitch);
    let inside = band(joint, pitch, x, texel) * band(joint, pitch, y, texel);
    let own = hash(cx as i32, cy as i32, seed);
    let marble = octaves(u, v, 0.4, texel, 0.66, own);
    let scuffs = octaves(u, v, 1.9, texel, 0.6, seed ^ 41);
    let face = tone + variety * ((own >> 8 & 0xFF) as f32 / 127.5 - 1.0) + 0.11 * marble + 0.10 * scuffs;
    mix(tone - 0.25, face, 1.0 - (1.0 - inside) * (joint / texel).min(1.0))
}

/// Rows of marks that look like print: words of random length on lines; 0 or 1 with soft edges.
fn print(u: f32, v: f32, line: f32, texel: f32, seed: u32) -> f32 {
    let row = (v / line).floor();
    let y = v - row * line;
    let letter = 0.45 * line;
    let column = (u / letter).floor();
    let (c, r) = (column as i32, row as i32);
    let is_space = cell(c, r, seed ^ 0xBEEF) < 0.2;
    let ends = cell(0, r, seed ^ 0xFACE) < 0.15;
    if is_space || ends {
        return 0.0;
    }
    let x = u - column * letter;
    let glyph = hash(c, r, seed);
    // Three bars of a seven-segment sign, chosen by the letter's own bits.
    let stroke = 0.11 * line;
    let mut ink = 0.0_f32;
    if glyph & 1 != 0 {
        ink = ink.max(
            band(0.08 * line, 0.08 * line + stroke, x, texel) * band(0.15 * line, 0.75 * line, y, texel),
        );
    }
    if glyph & 2 != 0 {
        ink = ink.max(
            band(0.28 * line, 0.28 * line + stroke, x, texel) * band(0.15 * line, 0.75 * line, y, texel),
        );
    }
    for (bit, at) in [(4, 0.15), (8, 0.40), (16, 0.65)] {
        if glyph & bit != 0 {
            let bar =
                band(at * line, at * line + stroke, y, texel) * band(0.08 * line, 0.38 * line, x, texel);
            ink = ink.max(bar);
        }
    }
    ink * (stroke / texel).min(1.0)
}

fn cardboard(u: f32, v: f32, size: [f32; 2], texel: f32, seed: u32, tone: f32) -> f32 {
    let fibres =
        octaves(u * 0.3, v, 0.02, texel, 0.8, seed) + 1.3 * octaves(u, v, 0.35, texel, 0.62, seed ^ 2);
    let mut value = tone + 0.09 * fibres;
    // Tape along the middle, a label, and stencilled print.
    let tape = band(0.46 * size[1], 0.46 * size[1] + 0.05, v, texel);
    value = mix(value, tone + 0.16, 0.8 * tape);
    let (lx, ly) = (size[0] * (0.08 + 0.4 * cell(1, 1, seed)), size[1] * (0.55 + 0.1 * cell(1, 2, seed)));
    let (lw, lh) = (0.42 * size[0], 0.3 * size[1]);
    let label = band(lx, lx + lw, u, texel) * band(ly, ly + lh, v, texel);
    let ink = print(u - lx - 0.01, v - ly, (0.2 * lh).max(0.012), texel, seed ^ 6);
    value = mix(value, 0.85 - 0.75 * ink, label);
    let stencil = print(u, v - 0.06 * size[1], 0.22 * size[1], texel, seed ^ 7)
        * band(0.06 * size[1], 0.28 * size[1], v, texel);
    mix(value, 0.12, 0.8 * stencil)
}

fn poster(u: f32, v: f32, size: [f32; 2], texel: f32, seed: u32) -> f32 {
    let span = size[0].min(size[1]);
    let slant = cell(0, 9, seed) - 0.5;
    let mut value = 0.25 + 0.5 * cell(0, 1, seed) + 0.3 * slant * (u / size[0] + v / size[1] - 1.0);
    value += 0.10 * octaves(u, v, 0.5 * span, texel, 0.65, seed ^ 50);
    // Discs, rings and bars, over one another.
    for k in 0..9 {
        let r = |n: i32| cell(k, n, seed ^ 0x1234);
        let (x, y, radius) = (size[0] * r(1), size[1] * r(2), span * (0.05 + 0.2 * r(3)));
        let shade = r(4);
        let mask = match k % 3 {
            0 => 1.0 - step(radius, length(u - x, v - y), texel),
            1 => {
                let d = length(u - x, v - y);
                band(0.6 * radius, radius, d, texel)
            }
            _ => {
                let (sin, cos) = (3.0 * r(5)).sin_cos();
                let (a, b) = ((u - x) * cos + (v - y) * sin, (v - y) * cos - (u - x) * sin);
                band(-1.6 * radius, 1.6 * radius, a, texel) * band(-0.2 * radius, 0.2 * radius, b, texel)
            }
        };
        value = mix(value, shade, 0.9 * mask);
    }
    let title =
        band(0.78 * size[1], 0.93 * size[1], v, texel) * band(0.06 * size[0], 0.94 * size[0], u, texel);
    let text = band(0.06 * size[1], 0.3 * size[1], v, texel) * band(0.08 * size[0], 0.92 * size[0], u, texel);
    let ink = title * print(u, v - 0.78 * size[1], 0.15 * size[1], texel, seed ^ 61)
        + text * print(u, v, 0.04 * size[1], texel, seed ^ 62);
    let dark = if value > 0.45 { 0.06 } else { 0.92 };
    mix(value, dark, ink.min(1.0)) + 0.03 * octaves(u, v, 0.05, texel, 0.7, seed ^ 63)
}

fn books(u: f32, v: f32, texel: f32, seed: u32) -> f32 {
    // Spines of random width: each cell of 6 cm holds two books split at a random place.
    let pitch = 0.06;
    let column = (u / pitch).floor();
    let x = u - column * pitch;
    let split = pitch * (0.35 + 0.3 * cell(column as i32, 0, seed));
    let second = x > split;
    let book = 2 * column as i32 + i32::from(second);
    let (left, width) = if second { (split, pitch - split) } else { (0.0, split) };
    let own = cell(book, 1, seed);
    let gap = 1.0 - band(0.002, width - 0.001, x - left, texel);
    let bands = step(0.75, value_noise(own * 31.0, v * 24.0, seed ^ 5) * 0.5 + 0.5, texel * 24.0);
    let ink = print(v + own, x - left, 0.5 * width, texel, seed ^ hash(book, 3, 4));
    let body = 0.12 + 0.68 * own + 0.05 * octaves(u, v, 0.05, texel, 0.7, seed);
    let marked = mix(mix(body, 1.0 - body, 0.7 * bands), if own > 0.5 { 0.08 } else { 0.9 }, 0.8 * ink);
    mix(marked, 0.04, gap)
}

fn door(u: f32, v: f32, size: [f32; 2], texel: f32, seed: u32, tone: f32) -> f32 {
    let grain = octaves(u, v * 0.12, 0.04, texel, 0.75, seed);
    let mut value = tone + 0.10 * grain + 0.07 * octaves(u, v, 0.6, texel, 0.65, seed ^ 3);
    for (low, high) in [(0.07, 0.42), (0.52, 0.92)] {
        let outer =
            band(0.15 * size[0], 0.85 * size[0], u, texel) * band(low * size[1], high * size[1], v, texel);
        let inner = band(0.15 * size[0] + 0.025, 0.85 * size[0] - 0.025, u, texel)
            * band(low * size[1] + 0.025, high * size[1] - 0.025, v, texel);
        value -= 0.18 * (outer - inner);
    }
    let handle =
        band(0.88 * size[0], 0.95 * size[0], u, texel) * band(0.46 * size[1], 0.49 * size[1], v, texel);
    mix(value, 0.85, handle)
}

fn board(u: f32, v: f32, size: [f32; 2], texel: f32, seed: u32) -> f32 {
    // A whiteboard with handwriting-like curves and notes.
    let mut value = 0.8 + 0.05 * octaves(u, v, 0.5, texel, 0.6, seed);
    for k in 0..5 {
        let n = octaves(u + 3.0 * k as f32, v, 0.35, 0.02, 0.5, seed ^ (90 + k));
        let line = 1.0 - (n.abs() / (0.03 + 4.0 * texel)).min(1.0);
        let there = step(0.1, value_noise(u * 1.7, v * 1.7 + k as f32, seed ^ (95 + k)), 0.2);
        value = mix(value, 0.15, 0.8 * line * there);
    }
    let (cx, cy) = ((u / 0.22).floor() as i32, (v / 0.2).floor() as i32);
    if cell(cx, cy, seed ^ 97) > 0.72 {
        let (x, y) = (u - cx as f32 * 0.22, v - cy as f32 * 0.2);
        let note = band(0.03, 0.14, x, texel) * band(0.03, 0.14, y, texel);
        let paper = 0.3 + 0.55 * cell(cx, cy, seed ^ 98);
        value = mix(value, paper - 0.25 * print(x, y, 0.018, texel, seed ^ 99), note);
    }
    let text = band(0.1 * size[0], 0.5 * size[0], u, texel) * band(0.55 * size[1], 0.9 * size[1], v, texel);
    mix(value, 0.1, text * print(u, v, 0.07, texel, seed ^ 100))
}

#[inline]
fn length(x: f32, y: f32) -> f32 {
    (x * x + y * y).sqrt()
}
