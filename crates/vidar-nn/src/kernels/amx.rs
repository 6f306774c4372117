//! bf16 matrix tiles (AMX): products of 32 rows by 32 columns in eight tile registers.
//!
//! The instructions are written as `asm!`, which is stable; the intrinsics are not. [`Tiles`] has two implementations with
//! the same addresses and the same order of sums: the hardware's, and plain Rust that reads memory exactly as
//! `tileloadd` does. The packing and the loops above are proved with the second one on any AVX-512 machine; the first
//! differs from it in three instructions only. As long as it has not been run on hardware by this project's tests,
//! [`Isa::detect`](crate::Isa::detect) does not choose it; it must be asked for.

use super::simd::SimdBf16;
use super::tile::{InBf16, Multiply, Sums};

/// Rows of a product's tile: two tile registers of sixteen.
const ROWS: usize = 32;
/// Rows and columns of a tile register, in 32-bit words.
const SIDE: usize = 16;
/// Columns of a panel.
const PANEL: usize = 2 * SIDE;

/// 32×32 sums of a tile.
#[repr(C, align(64))]
pub(crate) struct Block([[f32; PANEL]; ROWS]);

/// What multiplies tiles.
pub(crate) trait Tiles: Copy + Send + Sync {
    /// Prepares this thread's tile registers; what `leave` undoes.
    fn enter(self);
    fn leave(self);

    /// `c = Σ a b` over taps of `steps` words (a multiple of sixteen); with `both`, rows 16 to 31 as well.
    ///
    /// # Safety
    /// For each of the 16 (with `both`, 32) rows r and each tap, `a + r * stride + tap` must be readable for `2 * steps`
    /// numbers, and `b` for `taps * steps * 32` words. `enter` was called on this thread.
    unsafe fn multiply(
        self,
        a: (*const u16, usize),
        taps: &[usize],
        steps: usize,
        b: *const u32,
        both: bool,
        c: &mut Block,
    );
}

/// Factors in bf16, sums by tiles; everything else in the vectors of `S`, which must have sixteen lanes.
#[derive(Clone, Copy)]
pub(crate) struct InAmx<S, T> {
    pub(crate) vectors: S,
    pub(crate) tiles: T,
}

impl<S: SimdBf16, T: Tiles> Multiply for InAmx<S, T> {
    type Simd = S;
    type Number = u16;
    const STEP: usize = 2;
    const STEPS_UNIT: usize = SIDE;
    const ROWS: usize = ROWS;
    const READ_ROWS: usize = SIDE;

    #[inline(always)]
    fn simd(self) -> S {
        self.vectors
    }
    #[inline(always)]
    fn enter(self) {
        self.tiles.enter();
    }
    #[inline(always)]
    fn leave(self) {
        self.tiles.leave();
    }
    #[inline(always)]
    fn direct(_: &[f32]) -> Option<&[u16]> {
        None
    }
    #[inline(always)]
    fn convert(self, from: &[f32], to: &mut [u16]) {
        InBf16(self.vectors).convert(from, to);
    }
    #[inline(always)]
    fn convert_around(self, from: &[f32], centre: &[f32], to: &mut [u16]) {
        InBf16(self.vectors).convert_around(from, centre, to);
    }
    #[inline(always)]
    fn store(self, to: &mut [u16], v: S::V) {
        InBf16(self.vectors).store(to, v);
    }
    #[inline(always)]
    fn word(values: &[f32]) -> u32 {
        InBf16::<S>::word(values)
    }
    #[inline(always)]
    fn numbers(words: &mut [u32]) -> &mut [u16] {
        super::scratch::as_halves_mut(words)
    }

    #[inline(always)]
    unsafe fn tile(
        self,
        rows: usize,
        (a, stride): (*const u16, usize),
        taps: &[usize],
        steps: usize,
        b: *const u32,
        sums: &mut Sums<S>,
    ) {
        const { assert!(2 * S::LANES == PANEL, "tiles need vectors of sixteen lanes") };
        debug_assert!(rows <= ROWS && steps.is_multiple_of(SIDE));
        let s = self.vectors;
        let mut block = Block([[0.0; PANEL]; ROWS]);
        if steps > 0 && !taps.is_empty() {
            // SAFETY: the caller's promise, whose rows are rounded up to READ_ROWS.
            unsafe { self.tiles.multiply((a, stride), taps, steps, b, rows > SIDE, &mut block) };
        }
        for (sums, row) in sums.iter_mut().zip(&block.0).take(rows) {
            *sums = [s.load(row), s.load(&row[SIDE..])];
        }
    }
}

/// Tiles in plain Rust.
#[derive(Clone, Copy)]
#[cfg(test)]
pub(crate) struct Emulated;

#[cfg(test)]
impl Emulated {
    /// `tileloadd`: sixteen rows of 64 bytes, `stride` bytes apart.
    ///
    /// # Safety
    /// The rows must be readable.
    unsafe fn load(base: *const u8, stride: usize) -> [[u32; SIDE]; SIDE] {
        // SAFETY: the caller's promise.
        std::array::from_fn(|r| unsafe { base.add(r * stride).cast::<[u32; SIDE]>().read_unaligned() })
    }

    /// `tdpbf16ps`: for each row and column, sixteen pairs of products.
    fn dot(c: &mut [[f32; SIDE]; SIDE], a: &[[u32; SIDE]; SIDE], b: &[[u32; SIDE]; SIDE]) {
        let (low, high) = (|x: u32| f32::from_bits(x << 16), |x: u32| f32::from_bits(x & 0xFFFF_0000));
        for (c, a) in c.iter_mut().zip(a) {
            for (a, b) in a.iter().zip(b) {
                for (c, b) in c.iter_mut().zip(b) {
                    *c += low(*a) * low(*b);
                    *c += high(*a) * high(*b);
                }
            }
        }
    }
}

#[cfg(test)]
impl Tiles for Emulated {
    fn enter(self) {}
    fn leave(self) {}

    unsafe fn multiply(
        self,
        (a, stride): (*const u16, usize),
        taps: &[usize],
        steps: usize,
        b: *const u32,
        both: bool,
        c: &mut Block,
    ) {
        let mut sums = [[[[0.0f32; SIDE]; SIDE]; 2]; 2];
        let mut b = b.cast::<u8>();
        for tap in taps {
            for k in 0..steps / SIDE {
                // SAFETY: the caller's promise; these are the addresses that the instructions below read.
                unsafe {
                    let right = [Self::load(b, 4 * PANEL), Self::load(b.add(4 * SIDE), 4 * PANEL)];
                    b = b.add(4 * PANEL * SIDE);
                    for half in 0..1 + usize::from(both) {
                        let row = a.add(half * SIDE * stride + tap + 2 * SIDE * k);
                        let left = Self::load(row.cast(), 2 * stride);
                        Self::dot(&mut sums[half][0], &left, &right[0]);
                        Self::dot(&mut sums[half][1], &left, &right[1]);
                    }
                }
            }
        }
        for (r, row) in c.0.iter_mut().enumerate() {
            for (half, to) in row.chunks_exact_mut(SIDE).enumerate() {
                to.copy_from_slice(&sums[r / SIDE][half][r % SIDE]);
            }
        }
    }
}

#[cfg(target_os = "linux")]
pub(crate) use hardware::{Hardware, permitted};

#[cfg(target_os = "linux")]
mod hardware {
    use std::arch::asm;
    use std::arch::x86_64::{__cpuid, __cpuid_count};
    use std::sync::OnceLock;

    use super::{Block, PANEL, Tiles};

    /// The processor's tile registers.
    #[derive(Clone, Copy)]
    pub(crate) struct Hardware(());

    impl Hardware {
        /// # Safety
        /// [`permitted`] must have returned true.
        #[inline(always)]
        pub(crate) unsafe fn new() -> Self {
            Self(())
        }
    }

    /// Palette 1: eight tiles of sixteen rows of 64 bytes.
    #[repr(C, align(64))]
    struct Config {
        palette: u8,
        start_row: u8,
        reserved: [u8; 14],
        row_bytes: [u16; 16],
        rows: [u8; 16],
    }

    static CONFIG: Config = {
        let mut config =
            Config { palette: 1, start_row: 0, reserved: [0; 14], row_bytes: [0; 16], rows: [0; 16] };
        let mut i = 0;
        while i < 8 {
            config.row_bytes[i] = 64;
            config.rows[i] = 16;
            i += 1;
        }
        config
    };

    /// Whether processor and kernel have bf16 tiles; asks the kernel for the process's permission, once.
    pub(crate) fn permitted() -> bool {
        static PERMITTED: OnceLock<bool> = OnceLock::new();
        *PERMITTED.get_or_init(|| {
            if __cpuid(0).eax < 7 {
                return false;
            }
            let features = __cpuid_count(7, 0).edx;
            let (bf16, tile) = (features >> 22 & 1 == 1, features >> 24 & 1 == 1);
            bf16 && tile && request_permission()
        })
    }

    /// `arch_prctl(ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA)`: without it the first tile instruction is a fault. Kernels
    /// without AMX support refuse.
    fn request_permission() -> bool {
        const ARCH_PRCTL: i64 = 158;
        const ARCH_REQ_XCOMP_PERM: i64 = 0x1023;
        const XFEATURE_XTILEDATA: i64 = 18;
        let answer: i64;
        // SAFETY: a system call that changes nothing but this permission; it clobbers rcx and r11 only.
        unsafe {
            asm!("syscall", inlateout("rax") ARCH_PRCTL => answer, in("rdi") ARCH_REQ_XCOMP_PERM,
                in("rsi") XFEATURE_XTILEDATA, out("rcx") _, out("r11") _, options(nostack));
        }
        answer == 0
    }

    impl Tiles for Hardware {
        #[inline(always)]
        fn enter(self) {
            // SAFETY: tiles are permitted, and the configuration is a valid palette 1.
            unsafe {
                asm!("ldtilecfg [{}]", in(reg) &raw const CONFIG, options(nostack, readonly, preserves_flags))
            };
        }

        #[inline(always)]
        fn leave(self) {
            // SAFETY: tiles are permitted; nothing lives in them between products.
            unsafe { asm!("tilerelease", options(nostack, nomem, preserves_flags)) };
        }

        #[inline(always)]
        unsafe fn multiply(
            self,
            (a, stride): (*const u16, usize),
            taps: &[usize],
            steps: usize,
            b: *const u32,
            both: bool,
            c: &mut Block,
        ) {
            let c_low = c.0.as_mut_ptr().cast::<f32>();
            if both {
                let c_high = c_low.wrapping_add(16 * PANEL);
                // SAFETY: the caller's promise covers every load; the stores fill the block. The loops run over a number of
                // taps and steps that is not zero (checked by the caller).
                unsafe {
                    asm!(
                        "tilezero tmm0", "tilezero tmm1", "tilezero tmm2", "tilezero tmm3",
                        "2:",
                        "mov {k}, [{taps}]",
                        "lea {low}, [{a} + 2*{k}]",
                        "lea {high}, [{ah} + 2*{k}]",
                        "mov {k}, {steps}",
                        "3:",
                        "tileloadd tmm4, [{low} + {lda}*1]",
                        "tileloadd tmm6, [{b} + {ldb}*1]",
                        "tileloadd tmm7, [{b} + {ldb}*1 + 64]",
                        "tdpbf16ps tmm0, tmm4, tmm6",
                        "tdpbf16ps tmm1, tmm4, tmm7",
                        "tileloadd tmm5, [{high} + {lda}*1]",
                        "tdpbf16ps tmm2, tmm5, tmm6",
                        "tdpbf16ps tmm3, tmm5, tmm7",
                        "add {low}, 64", "add {high}, 64", "add {b}, 2048",
                        "dec {k}", "jnz 3b",
                        "add {taps}, 8",
                        "cmp {taps}, {end}", "jne 2b",
                        "tilestored [{c} + {ldb}*1], tmm0",
                        "tilestored [{c} + {ldb}*1 + 64], tmm1",
                        "tilestored [{ch} + {ldb}*1], tmm2",
                        "tilestored [{ch} + {ldb}*1 + 64], tmm3",
                        a = in(reg) a, ah = in(reg) a.add(16 * stride), lda = in(reg) 2 * stride,
                        taps = inout(reg) taps.as_ptr() => _, end = in(reg) taps.as_ptr_range().end,
                        steps = in(reg) steps / 16, b = inout(reg) b => _, ldb = in(reg) 4 * PANEL,
                        c = in(reg) c_low, ch = in(reg) c_high,
                        k = out(reg) _, low = out(reg) _, high = out(reg) _, options(nostack)
                    );
                }
                return;
            }
            // SAFETY: as above, for the first sixteen rows.
            unsafe {
                asm!(
                    "tilezero tmm0", "tilezero tmm1",
                    "2:",
                    "mov {k}, [{taps}]",
                    "lea {low}, [{a} + 2*{k}]",
                    "mov {k}, {steps}",
                    "3:",
                    "tileloadd tmm4, [{low} + {lda}*1]",
                    "tileloadd tmm6, [{b} + {ldb}*1]",
                    "tileloadd tmm7, [{b} + {ldb}*1 + 64]",
                    "tdpbf16ps tmm0, tmm4, tmm6",
                    "tdpbf16ps tmm1, tmm4, tmm7",
                    "add {low}, 64", "add {b}, 2048",
                    "dec {k}", "jnz 3b",
                    "add {taps}, 8",
                    "cmp {taps}, {end}", "jne 2b",
                    "tilestored [{c} + {ldb}*1], tmm0",
                    "tilestored [{c} + {ldb}*1 + 64], tmm1",
                    a = in(reg) a, lda = in(reg) 2 * stride,
                    taps = inout(reg) taps.as_ptr() => _, end = in(reg) taps.as_ptr_range().end,
                    steps = in(reg) steps / 16, b = inout(reg) b => _, ldb = in(reg) 4 * PANEL,
                    c = in(reg) c_low, k = out(reg) _, low = out(reg) _, options(nostack)
                );
            }
        }
    }
}

#[cfg(test)]
mod tests;
