//! [`crate::update`] with AVX2: the same operations in the same order, eight nodes at a time, the same bits.
//!
//! No fused multiply-add: it would round differently.

use crate::block::{Block, ColorRow, DISTANCE_ONE, Row};
use crate::grid::EDGE;
use crate::sample::{ROUND, Sample};
use crate::update::{BlockUpdate, NEAR_M};
use std::arch::x86_64::*;

/// Whether the gathers' indices, of 32 bits, reach all of the view's buffers and no further.
pub(crate) fn can_add(update: &BlockUpdate<'_>) -> bool {
    let pixels = update.samples.len();
    let fits = |items: usize| (2..=i32::MAX as usize / size_of::<Sample>()).contains(&items);
    fits(pixels) && update.colors.is_none_or(|colors| colors.len() == 3 * pixels + 1)
}

/// Constants of all rows, in vectors.
struct Constants {
    pixels: __m256i,
    k: [__m256; 4],
    /// Offsets of the eight nodes from the first, per axis.
    ramp: [__m256; 3],
    right: __m256,
    bottom: __m256,
    width: __m256i,
    truncation: __m256,
    per_truncation: __m256,
    per_fade: __m256,
}

/// Adds a view to `block`, as [`BlockUpdate::add_to`]; only after [`can_add`].
#[target_feature(enable = "avx2")]
pub(crate) fn add_rows(update: &BlockUpdate<'_>, block: &mut Block, origin: [f32; 3]) {
    // What the unsafe gathers below rely on.
    if !can_add(update) {
        return;
    }
    let index = _mm256_setr_ps(0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0);
    let constants = Constants {
        pixels: _mm256_set1_epi32(update.samples.len() as i32),
        k: update.k.map(|v| _mm256_set1_ps(v)),
        ramp: update.steps[0].map(|s| _mm256_mul_ps(index, _mm256_set1_ps(s))),
        right: _mm256_set1_ps(update.width as f32 - 0.5),
        bottom: _mm256_set1_ps(update.height as f32 - 0.5),
        width: _mm256_set1_epi32(update.width as i32),
        truncation: _mm256_set1_ps(update.truncation_m),
        per_truncation: _mm256_set1_ps(1.0 / update.truncation_m),
        per_fade: _mm256_set1_ps(1.0 / (update.truncation_m - update.voxel_m)),
    };
    let mut colors = block.color.as_deref_mut();
    for layer in 0..EDGE {
        // All rows are projected before any is updated: a mispredicted branch of `add_row` would otherwise discard the
        // loads of the next rows. The sums are prefetched meanwhile.
        let mut projected = [ProjectedRow::NOTHING; EDGE];
        for (y, projected) in projected.iter_mut().enumerate() {
            let at = layer * EDGE + y;
            prefetch(&block.rows[at]);
            if let Some(colors) = &colors {
                prefetch(&colors[at]);
            }
            *projected = project(update, &constants, update.row_start(at, origin));
        }
        for (y, projected) in projected.iter().enumerate() {
            let at = layer * EDGE + y;
            let row = &mut block.rows[at];
            add_row(update, &constants, row, colors.as_mut().map(|c| &mut c[at]), projected);
        }
    }
}

/// Pixels of the eight nodes of a row.
#[derive(Clone, Copy)]
struct ProjectedRow {
    /// Pixel of each node; not in the image where `packed` is 0.
    pixel: __m256i,
    /// Depth of the pixel minus z of the node.
    distance: __m256,
    /// Weight and confidence of the pixel.
    packed: __m256i,
}

impl ProjectedRow {
    const NOTHING: Self = {
        // SAFETY: vectors are numbers for which all bits are valid.
        unsafe { std::mem::zeroed() }
    };
}

/// The samples at four pixels, each in 64 bits; 0 where not `inside`.
///
/// Loads, not gathers: those are many small steps on AMD and slowed down by a security patch on Intel.
#[inline]
#[target_feature(enable = "avx2")]
fn samples_at(samples: &[Sample], pixel: __m128i, inside: __m128i) -> __m256i {
    const { assert!(size_of::<Sample>() == size_of::<u64>()) };
    let pixel = _mm_and_si128(pixel, inside);
    let load = |two_pixels: i64| {
        let [one, other] = [two_pixels as u32, (two_pixels as u64 >> 32) as u32];
        let base = samples.as_ptr();
        // SAFETY: a pixel is 0 or inside, so less than samples.len(), which is not 0 (`can_add`); a sample has 8 bytes.
        let (one, other) = unsafe { (base.add(one as usize), base.add(other as usize)) };
        // SAFETY: as above; neither access requires alignment.
        unsafe { _mm_loadh_pd(_mm_castsi128_pd(_mm_loadl_epi64(one.cast())), other.cast()) }
    };
    let first = load(_mm_cvtsi128_si64(pixel));
    let second = load(_mm_extract_epi64::<1>(pixel));
    let four = _mm256_castpd_si256(_mm256_set_m128d(second, first));
    _mm256_and_si256(four, _mm256_cvtepi32_epi64(inside))
}

/// Prefetches a row of sums, two cache lines.
#[inline]
#[target_feature(enable = "avx2")]
fn prefetch<T>(row: &T) {
    let first = std::ptr::from_ref(row).cast::<i8>();
    _mm_prefetch::<_MM_HINT_T0>(first);
    _mm_prefetch::<_MM_HINT_T0>(first.wrapping_add(64));
}

#[inline]
#[target_feature(enable = "avx2")]
fn project(update: &BlockUpdate<'_>, c: &Constants, start: [f32; 3]) -> ProjectedRow {
    let [x, y, z] = [0, 1, 2].map(|a| _mm256_add_ps(_mm256_set1_ps(start[a]), c.ramp[a]));
    let per_z = _mm256_div_ps(_mm256_set1_ps(1.0), z);
    let u = _mm256_add_ps(_mm256_mul_ps(_mm256_mul_ps(c.k[0], x), per_z), c.k[2]);
    let v = _mm256_add_ps(_mm256_mul_ps(_mm256_mul_ps(c.k[1], y), per_z), c.k[3]);
    let low = _mm256_set1_ps(-0.5);
    // Ordered comparisons: NaN is outside.
    let in_front = _mm256_cmp_ps::<_CMP_GT_OQ>(z, _mm256_set1_ps(NEAR_M));
    let in_u = _mm256_and_ps(_mm256_cmp_ps::<_CMP_GT_OQ>(u, low), _mm256_cmp_ps::<_CMP_LT_OQ>(u, c.right));
    let in_v = _mm256_and_ps(_mm256_cmp_ps::<_CMP_GT_OQ>(v, low), _mm256_cmp_ps::<_CMP_LT_OQ>(v, c.bottom));
    let inside = _mm256_castps_si256(_mm256_and_ps(in_front, _mm256_and_ps(in_u, in_v)));
    let pixel = _mm256_add_epi32(_mm256_mullo_epi32(round(v), c.width), round(u));
    let in_list = _mm256_and_si256(
        _mm256_cmpgt_epi32(pixel, _mm256_set1_epi32(-1)),
        _mm256_cmpgt_epi32(c.pixels, pixel),
    );
    let inside = _mm256_and_si256(inside, in_list);
    let (first, second) = (
        samples_at(update.samples, _mm256_castsi256_si128(pixel), _mm256_castsi256_si128(inside)),
        samples_at(
            update.samples,
            _mm256_extracti128_si256::<1>(pixel),
            _mm256_extracti128_si256::<1>(inside),
        ),
    );
    let (first, second) = (_mm256_castsi256_ps(first), _mm256_castsi256_ps(second));
    // Halves of each sample side by side, within 128 bits; then in the order of nodes.
    let depth = _mm256_castps_pd(_mm256_shuffle_ps::<0b10_00_10_00>(first, second));
    let packed = _mm256_castps_pd(_mm256_shuffle_ps::<0b11_01_11_01>(first, second));
    let depth = _mm256_castpd_ps(_mm256_permute4x64_pd::<0b11_01_10_00>(depth));
    let packed = _mm256_castpd_si256(_mm256_permute4x64_pd::<0b11_01_10_00>(packed));
    ProjectedRow { pixel, distance: _mm256_sub_ps(depth, z), packed }
}

#[inline]
#[target_feature(enable = "avx2")]
fn add_row(
    update: &BlockUpdate<'_>,
    c: &Constants,
    row: &mut Row,
    color: Option<&mut ColorRow>,
    projected: &ProjectedRow,
) {
    let &ProjectedRow { pixel, distance, packed } = projected;
    let zero = _mm256_setzero_si256();
    let one = _mm256_set1_ps(1.0);
    let fade = _mm256_mul_ps(_mm256_add_ps(distance, c.truncation), c.per_fade);
    let fade = clamp(fade, _mm256_setzero_ps(), one);
    let d = clamp(_mm256_mul_ps(distance, c.per_truncation), _mm256_set1_ps(-1.0), one);
    let full = _mm256_cvtepi32_ps(_mm256_and_si256(packed, _mm256_set1_epi32(0xffff)));
    let weight = round(_mm256_mul_ps(full, fade));
    // Rows behind the surface are many and change nothing.
    if _mm256_testz_si256(weight, weight) != 0 {
        return;
    }
    let product = _mm256_mullo_epi32(weight, round(_mm256_mul_ps(d, _mm256_set1_ps(DISTANCE_ONE))));
    let within = _mm256_castps_si256(_mm256_cmp_ps::<_CMP_LE_OQ>(distance, c.truncation));
    let near = _mm256_and_si256(within, _mm256_cmpgt_epi32(weight, zero));
    let confidence_and_one =
        _mm256_or_si256(_mm256_and_si256(packed, _mm256_set1_epi32(-65536)), _mm256_set1_epi32(1));
    accumulate(&mut row.distance, product);
    accumulate(&mut row.weight, weight);
    if _mm256_testz_si256(near, near) != 0 {
        return;
    }
    accumulate(&mut row.near, _mm256_and_si256(near, confidence_and_one));
    if let (Some(sums), Some(colors)) = (color, update.colors) {
        let confidence = _mm256_and_si256(near, _mm256_srli_epi32::<16>(packed));
        add_colors(sums, colors, pixel, near, confidence);
    }
}

/// Adds the colours of the pixels where `near`, times their confidences.
#[inline]
#[target_feature(enable = "avx2")]
fn add_colors(sums: &mut ColorRow, colors: &[u8], pixel: __m256i, near: __m256i, confidence: __m256i) {
    let at = _mm256_add_epi32(pixel, _mm256_slli_epi32::<1>(pixel));
    // SAFETY: a lane is read only where 0 ≤ pixel < samples.len() (the mask), hence up to byte
    // 3 · samples.len() = colors.len() − 1 (`can_add`).
    let rgb = unsafe {
        _mm256_mask_i32gather_epi32::<1>(_mm256_setzero_si256(), colors.as_ptr().cast::<i32>(), at, near)
    };
    let byte = _mm256_set1_epi32(0xff);
    let channels = [
        _mm256_and_si256(rgb, byte),
        _mm256_and_si256(_mm256_srli_epi32::<8>(rgb), byte),
        _mm256_and_si256(_mm256_srli_epi32::<16>(rgb), byte),
    ];
    for (sum, channel) in sums.iter_mut().zip(channels) {
        accumulate(sum, _mm256_mullo_epi32(channel, confidence));
    }
    accumulate(&mut sums[3], confidence);
}

/// Adds to eight sums of 32 bits.
#[inline]
#[target_feature(enable = "avx2")]
fn accumulate<T>(sums: &mut [T; EDGE], add: __m256i) {
    const { assert!(size_of::<[T; EDGE]>() == size_of::<__m256i>()) };
    let at = std::ptr::from_mut(sums).cast::<__m256i>();
    // SAFETY: the reference is to as many bytes as a vector, and neither access requires alignment. T is i32 or u32,
    // for which all bits are valid.
    unsafe { _mm256_storeu_si256(at, _mm256_add_epi32(_mm256_loadu_si256(at), add)) };
}

/// See [`crate::sample::round_to_i32`].
#[inline]
#[target_feature(enable = "avx2")]
fn round(x: __m256) -> __m256i {
    let shifted = _mm256_castps_si256(_mm256_add_ps(x, _mm256_set1_ps(ROUND)));
    _mm256_sub_epi32(shifted, _mm256_set1_epi32(ROUND.to_bits() as i32))
}

#[inline]
#[target_feature(enable = "avx2")]
fn clamp(x: __m256, low: __m256, high: __m256) -> __m256 {
    _mm256_min_ps(_mm256_max_ps(x, low), high)
}
