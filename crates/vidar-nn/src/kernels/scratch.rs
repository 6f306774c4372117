//! Buffers that kernels reuse from call to call, aligned to cache lines.

use std::cell::RefCell;

#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct Line([u32; 16]);

/// Words with 64-byte alignment; their content is whatever the last user left.
#[derive(Default)]
pub(crate) struct Scratch {
    lines: Vec<Line>,
}

impl std::fmt::Debug for Scratch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Scratch({} bytes)", self.bytes())
    }
}

impl Scratch {
    /// At least `len` words.
    pub(crate) fn words(&mut self, len: usize) -> &mut [u32] {
        let lines = len.div_ceil(16);
        if self.lines.len() < lines {
            // Old content is not worth copying.
            self.lines = Vec::new();
            self.lines.resize(lines, Line([0; 16]));
        }
        // SAFETY: lines are arrays of 16 words without padding; all of them are initialised.
        unsafe { std::slice::from_raw_parts_mut(self.lines.as_mut_ptr().cast(), self.lines.len() * 16) }
    }

    /// At least `len` numbers.
    pub(crate) fn floats(&mut self, len: usize) -> &mut [f32] {
        as_floats_mut(self.words(len))
    }

    /// Room for `len` words, zeros.
    pub(crate) fn with_words(len: usize) -> Self {
        let mut scratch = Self::default();
        scratch.words(len);
        scratch
    }

    /// All words there are.
    pub(crate) fn filled(&self) -> &[u32] {
        // SAFETY: lines are arrays of 16 words without padding; all of them are initialised.
        unsafe { std::slice::from_raw_parts(self.lines.as_ptr().cast(), self.lines.len() * 16) }
    }

    pub(crate) fn bytes(&self) -> usize {
        self.lines.len() * 64
    }
}

/// The same words as numbers.
pub(crate) fn as_floats_mut(words: &mut [u32]) -> &mut [f32] {
    // SAFETY: f32 and u32 have the same size and alignment, and every bit pattern is valid for both.
    unsafe { std::slice::from_raw_parts_mut(words.as_mut_ptr().cast(), words.len()) }
}

/// The same numbers as words.
pub(crate) fn as_words_mut(floats: &mut [f32]) -> &mut [u32] {
    // SAFETY: f32 and u32 have the same size and alignment, and every bit pattern is valid for both.
    unsafe { std::slice::from_raw_parts_mut(floats.as_mut_ptr().cast(), floats.len()) }
}

/// The same words as pairs of halves.
pub(crate) fn as_halves_mut(words: &mut [u32]) -> &mut [u16] {
    // SAFETY: a word is two halves, of lesser alignment, and every bit pattern is valid for both.
    unsafe { std::slice::from_raw_parts_mut(words.as_mut_ptr().cast(), words.len() * 2) }
}

/// Buffers larger than this are given back to the system after use.
const KEEP_BYTES: usize = 8 << 20;

/// What a buffer is for; each thread keeps one of each.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Role {
    /// Packed panels of weights, shared by the tasks of a product.
    Panels,
    /// Weights on their way into panels.
    Columns,
    /// Kernels of a convolution on their way into columns.
    Kernels,
    /// Input rows of a task.
    Rows,
    /// Input rows of a band of a fused head.
    Band,
    /// Blocks of a task of attention, or a band of a fused head.
    Block,
    /// Numbers between the two products of a fused head.
    Middle,
    /// Keys and values of a call of attention.
    Keys,
}

const ROLES: usize = 8;

thread_local! {
    static KEPT: RefCell<[Scratch; ROLES]> = const { RefCell::new([const { Scratch { lines: Vec::new() } }; ROLES]) };
}

/// A scratch buffer of this thread; kept for the next borrower when dropped.
pub(crate) struct Borrowed {
    scratch: Scratch,
    role: Role,
}

/// Takes this thread's buffer for a role, or an empty one while another borrower has it (a thread that waits for its
/// tasks may be given tasks of another call).
pub(crate) fn borrow(role: Role) -> Borrowed {
    Borrowed { scratch: KEPT.with(|kept| std::mem::take(&mut kept.borrow_mut()[role as usize])), role }
}

impl Drop for Borrowed {
    fn drop(&mut self) {
        let scratch = std::mem::take(&mut self.scratch);
        if scratch.bytes() <= KEEP_BYTES {
            // When the thread is ending there is nowhere to keep it: then it is simply freed.
            let _ = KEPT.try_with(|kept| {
                let slot = &mut kept.borrow_mut()[self.role as usize];
                if slot.bytes() < scratch.bytes() {
                    *slot = scratch;
                }
            });
        }
    }
}

impl std::ops::Deref for Borrowed {
    type Target = Scratch;
    fn deref(&self) -> &Scratch {
        &self.scratch
    }
}

impl std::ops::DerefMut for Borrowed {
    fn deref_mut(&mut self) -> &mut Scratch {
        &mut self.scratch
    }
}
