//! Numbers that begin with a line of the cache.

use std::ops::{Deref, DerefMut};

/// Numbers of a line of the cache: 64 bytes.
pub(super) const LINE: usize = 8;

/// Numbers of which the first lies at the beginning of a line: a vector of eight that begins elsewhere touches two, which takes twice the time to load.
#[derive(Debug)]
pub(super) struct Aligned {
    all: Vec<f64>,
    begin: usize,
}

impl Aligned {
    pub(super) fn zeros(length: usize) -> Self {
        let all = vec![0.0; length + LINE - 1];
        // Without an answer only speed is lost.
        let begin = all.as_ptr().align_offset(LINE * size_of::<f64>()).min(LINE - 1);
        Self { all, begin }
    }

    fn end(&self) -> usize {
        self.all.len() - (LINE - 1) + self.begin
    }
}

impl Clone for Aligned {
    fn clone(&self) -> Self {
        let mut copy = Self::zeros(self.len());
        copy.copy_from_slice(self);
        copy
    }
}

impl Deref for Aligned {
    type Target = [f64];

    fn deref(&self) -> &[f64] {
        &self.all[self.begin..self.end()]
    }
}

impl DerefMut for Aligned {
    fn deref_mut(&mut self) -> &mut [f64] {
        let (begin, end) = (self.begin, self.end());
        &mut self.all[begin..end]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copies_begin_with_a_line_too() {
        for length in [0, 1, 9, 100_000] {
            let mut values = Aligned::zeros(length);
            values.iter_mut().enumerate().for_each(|(k, v)| *v = k as f64);
            let copy = values.clone();
            assert_eq!(values[..], copy[..]);
            assert_eq!(values.len(), length);
            for values in [&values, &copy] {
                assert_eq!(values.as_ptr() as usize % 64, 0);
            }
        }
    }
}
