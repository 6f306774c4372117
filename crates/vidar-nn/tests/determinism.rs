//! The same bits for any number of threads, and no memory that grows with the number of calls.
#![allow(clippy::unwrap_used)] // tests may stop at the first surprise

mod common;

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicIsize, Ordering};

use common::{Numbers, all_computes};
use vidar_nn::{
    AttentionSpec, Compute, Conv2d, ConvInput, ConvTranspose2d, Corners, Epilogue, HeadBranch, HeadInput,
    LayerNorm, Linear, MapRef, MapSize, RopeTable, activation, attention, head, resize_bilinear,
};

/// Counts the bytes that are allocated and not yet freed.
struct Counting;

static HELD: AtomicIsize = AtomicIsize::new(0);

// SAFETY: everything is handed on to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        HELD.fetch_add(layout.size().cast_signed(), Ordering::Relaxed);
        // SAFETY: the caller's promise.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        HELD.fetch_sub(layout.size().cast_signed(), Ordering::Relaxed);
        // SAFETY: the caller's promise.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// A miniature network that uses every operation.
struct Net {
    qkv: Linear,
    gated: Linear,
    norm: LayerNorm,
    head_norm: LayerNorm,
    rope: RopeTable,
    conv: Conv2d,
    down: Conv2d,
    spread: ConvTranspose2d,
    middle: Conv2d,
    point: Conv2d,
    x: Vec<f32>,
}

const ROWS: usize = 19;
const COLS: usize = 13;
const D: usize = 48;

impl Net {
    fn new() -> Self {
        let mut n = Numbers(31);
        let positions: Vec<[f32; 2]> =
            (0..ROWS * COLS).map(|t| [(t / COLS) as f32, (t % COLS) as f32]).collect();
        Self {
            qkv: Linear::new(n.weight(&[3 * D, D]), Some(n.weight(&[3 * D]))).unwrap(),
            gated: Linear::new(n.weight(&[2 * D, D]), None).unwrap(),
            norm: LayerNorm::new(n.weight(&[D]), n.weight(&[D]), 1e-6).unwrap(),
            head_norm: LayerNorm::new(n.weight(&[24]), n.weight(&[24]), 1e-5).unwrap(),
            rope: RopeTable::new(&positions, 24, 100.0),
            conv: Conv2d::new(n.weight(&[D, D, 3, 3]), Some(n.weight(&[D])), 1, 1).unwrap(),
            down: Conv2d::new(n.weight(&[D, D, 3, 3]), None, 2, 1).unwrap(),
            spread: ConvTranspose2d::new(n.weight(&[D, 10, 2, 2]), Some(n.weight(&[10]))).unwrap(),
            middle: Conv2d::new(n.weight(&[32, 10, 3, 3]), Some(n.weight(&[32])), 1, 1).unwrap(),
            point: Conv2d::new(n.weight(&[2, 32, 1, 1]), Some(n.weight(&[2])), 1, 0).unwrap(),
            x: n.vec(ROWS * COLS * D),
        }
    }

    fn run(&self, c: &Compute) -> Vec<f32> {
        let tokens = ROWS * COLS;
        let mut qkv = vec![0.0; tokens * 3 * D];
        let mut normed = vec![0.0; self.x.len()];
        self.norm.apply(c, &self.x, &mut normed);
        self.qkv.apply(c, &normed, tokens, &mut qkv, Epilogue::None);
        let norms = Some((&self.head_norm, &self.head_norm));
        let spec = AttentionSpec { heads: 2, head_dim: 24, qk_norm: norms, rope: Some(&self.rope) };
        let mut x = vec![0.0; tokens * D];
        attention(c, &qkv, 1, tokens, &spec, &mut x);
        let mut gated = vec![0.0; tokens * D];
        self.gated.apply_swiglu(c, &x, tokens, &mut gated);
        activation::gelu(c, &mut gated);
        let mut map = vec![0.0; tokens * D];
        let end = Epilogue::Add(&x);
        self.conv.apply(c, MapRef::new(&gated, ROWS, COLS), &mut map, ConvInput::Relu, end);
        let (h, w) = self.down.output_size(ROWS, COLS);
        let mut small = vec![0.0; h * w * D];
        self.down.apply(c, MapRef::new(&map, ROWS, COLS), &mut small, ConvInput::None, Epilogue::Gelu);
        let mut back = vec![0.0; tokens * D];
        let size = MapSize { rows: ROWS, cols: COLS };
        resize_bilinear(c, MapRef::new(&small, h, w), D, size, Corners::Aligned, &mut back);
        let mut wide = vec![0.0; tokens * 4 * 10];
        self.spread.apply(c, MapRef::new(&back, ROWS, COLS), &mut wide);
        let size = MapSize { rows: 3 * ROWS, cols: 3 * COLS };
        let mut out = vec![0.0; size.rows * size.cols * 2];
        let map = MapRef::new(&wide, 2 * ROWS, 2 * COLS);
        let input = HeadInput { map, channels: 10, size, corners: Corners::Aligned, embedding: None };
        let branch = HeadBranch { conv: &self.middle, norm: None, point: &self.point, out: &mut out };
        head(c, &input, &mut [branch]);
        out
    }
}

fn with_threads<T: Send>(threads: usize, work: impl FnOnce() -> T + Send) -> T {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(work)
}

// One test, so that no other allocates meanwhile.
#[test]
fn any_number_of_threads_gives_the_same_bits_and_memory_does_not_grow() {
    let net = Net::new();
    for c in all_computes() {
        let one = with_threads(1, || net.run(&c));
        assert!(one.iter().all(|x| x.is_finite()) && one.iter().any(|x| *x != one[0]), "{c:?}");
        for threads in [2, 4, 7] {
            let many = with_threads(threads, || net.run(&c));
            assert!(
                one.iter().zip(&many).all(|(a, b)| a.to_bits() == b.to_bits()),
                "{c:?}, {threads} threads"
            );
        }
    }

    let c = Compute::default();
    with_threads(2, || {
        let held_after = |calls: usize| {
            for _ in 0..calls {
                net.run(&c);
            }
            HELD.load(Ordering::Relaxed)
        };
        // Each thread first gets its scratch buffers; which thread meets which size is a matter of chance.
        let warm = held_after(200);
        let later = held_after(1000);
        assert!(later - warm < 256 << 10, "{warm} bytes after 200 calls, {later} after 1,200");
    });
}
