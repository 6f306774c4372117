//! Colour maps with monotone lightness, readable in grey print and with colour blindness.
//!
//! Each map is a path through OKLCH (Ottosson, "A perceptual color space for image processing", 2020): lightness is
//! linear in the value, hue turns along a few stops, and chroma is as strong as sRGB allows up to a cap.

use std::sync::LazyLock;

/// A map from 0…1 to a colour.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ColorMap {
    /// Dark violet over blue and green to bright yellow: lightness rises. For depth and confidence.
    Sea,
    /// Pale yellow over orange and red to dark purple: lightness falls. For errors, where dark means bad.
    Ember,
}

struct Recipe {
    lightness: (f64, f64),
    /// Hue in degrees at even steps.
    hues: &'static [f64],
    chroma_cap: f64,
}

const SEA: Recipe = Recipe {
    lightness: (0.24, 0.93),
    hues: &[305.0, 285.0, 258.0, 222.0, 182.0, 150.0, 126.0, 106.0],
    chroma_cap: 0.15,
};
const EMBER: Recipe = Recipe {
    lightness: (0.95, 0.28),
    hues: &[105.0, 85.0, 62.0, 42.0, 26.0, 5.0, 340.0, 318.0],
    chroma_cap: 0.17,
};

type Table = [[u8; 3]; 256];
static SEA_TABLE: LazyLock<Table> = LazyLock::new(|| table(&SEA));
static EMBER_TABLE: LazyLock<Table> = LazyLock::new(|| table(&EMBER));

impl ColorMap {
    /// The colour of `t`, clamped to 0…1; NaN is the dark grey that means "no data".
    pub fn color(self, t: f32) -> [u8; 3] {
        if t.is_nan() {
            return crate::canvas::theme::NO_DATA;
        }
        let index = (t.clamp(0.0, 1.0) * 255.0).round() as usize;
        match self {
            Self::Sea => SEA_TABLE[index],
            Self::Ember => EMBER_TABLE[index],
        }
    }
}

fn table(recipe: &Recipe) -> Table {
    std::array::from_fn(|i| {
        let t = i as f64 / 255.0;
        let lightness = recipe.lightness.0 + t * (recipe.lightness.1 - recipe.lightness.0);
        let place = t * (recipe.hues.len() - 1) as f64;
        let (from, share) = (place.floor() as usize, place.fract());
        let h0 = recipe.hues[from];
        let h1 = recipe.hues[(from + 1).min(recipe.hues.len() - 1)];
        // Red is at the wrap-around of the circle, so the shorter way round is taken.
        let turn = (h1 - h0 + 540.0).rem_euclid(360.0) - 180.0;
        strongest(lightness, h0 + share * turn, recipe.chroma_cap)
    })
}

/// The most saturated sRGB colour of this lightness and hue, up to `cap`.
fn strongest(lightness: f64, hue_deg: f64, cap: f64) -> [u8; 3] {
    let (sin, cos) = hue_deg.to_radians().sin_cos();
    let at = |chroma: f64| linear_srgb(lightness, chroma * cos, chroma * sin);
    let fits = |rgb: &[f64; 3]| rgb.iter().all(|c| (-1e-4..=1.0001).contains(c));
    let (mut low, mut high) = (0.0, cap);
    if fits(&at(cap)) {
        low = cap;
    }
    // Twenty bisections are finer than eight bits.
    for _ in 0..20 {
        let middle = 0.5 * (low + high);
        if fits(&at(middle)) { low = middle } else { high = middle }
    }
    at(low).map(|c| (encode_srgb(c) * 255.0).round() as u8)
}

fn linear_srgb(l: f64, a: f64, b: f64) -> [f64; 3] {
    let long = (l + 0.396_337_777_4 * a + 0.215_803_757_3 * b).powi(3);
    let medium = (l - 0.105_561_345_8 * a - 0.063_854_172_8 * b).powi(3);
    let short = (l - 0.089_484_177_5 * a - 1.291_485_548 * b).powi(3);
    [
        4.076_741_662_1 * long - 3.307_711_591_3 * medium + 0.230_969_929_2 * short,
        -1.268_438_004_6 * long + 2.609_757_401_1 * medium - 0.341_319_396_5 * short,
        -0.004_196_086_3 * long - 0.703_418_614_7 * medium + 1.707_614_701 * short,
    ]
}

fn encode_srgb(c: f64) -> f64 {
    let c = c.clamp(0.0, 1.0);
    if c <= 0.003_130_8 { 12.92 * c } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Relative luminance (BT.709).
    fn luminance([r, g, b]: [u8; 3]) -> f64 {
        let linear = |c: u8| {
            let c = f64::from(c) / 255.0;
            if c <= 0.040_45 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
        };
        0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b)
    }

    #[test]
    fn luminance_is_monotone_along_each_map() {
        for (map, sign) in [(ColorMap::Sea, 1.0), (ColorMap::Ember, -1.0)] {
            for i in 0..63 {
                // Steps of four: single steps may be lost in the rounding to eight bits.
                let at = |k: usize| luminance(map.color((4 * k) as f32 / 255.0));
                assert!(sign * (at(i + 1) - at(i)) > 0.0, "{map:?} at {i}");
            }
            let range = luminance(map.color(0.0)) - luminance(map.color(1.0));
            assert!(range.abs() > 0.6, "{map:?} spans only {range}");
        }
    }

    #[test]
    fn values_outside_are_clamped_and_nan_is_grey() {
        assert_eq!(ColorMap::Sea.color(-3.0), ColorMap::Sea.color(0.0));
        assert_eq!(ColorMap::Sea.color(f32::INFINITY), ColorMap::Sea.color(1.0));
        let [r, g, b] = ColorMap::Sea.color(f32::NAN);
        assert!(r.abs_diff(g) < 4 && g.abs_diff(b) < 4 && r < 90);
    }

    #[test]
    fn no_colour_of_a_map_is_mistaken_for_no_data() {
        let none = ColorMap::Sea.color(f32::NAN);
        for map in [ColorMap::Sea, ColorMap::Ember] {
            for i in 0..=255 {
                let c = map.color(i as f32 / 255.0);
                let difference: u32 = c.iter().zip(&none).map(|(a, b)| u32::from(a.abs_diff(*b))).sum();
                assert!(difference > 40, "{map:?} at {i}: {c:?}");
            }
        }
    }
}
