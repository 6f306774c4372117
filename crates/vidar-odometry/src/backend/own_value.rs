//! A value that every frame of the window has of its own, beside its state.

use nalgebra::SVector;

/// The value, with its linearisation point and step once it is in the prior: `now = linearised + step`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct OwnValue<const N: usize> {
    pub(crate) now: SVector<f64, N>,
    linearised: SVector<f64, N>,
    pub(crate) step: SVector<f64, N>,
    in_prior: bool,
}

impl<const N: usize> Default for OwnValue<N> {
    fn default() -> Self {
        Self::new(SVector::zeros())
    }
}

impl<const N: usize> OwnValue<N> {
    pub(crate) fn new(now: SVector<f64, N>) -> Self {
        Self { now, linearised: SVector::zeros(), step: SVector::zeros(), in_prior: false }
    }

    pub(crate) fn enter_prior(&mut self) {
        if !self.in_prior {
            self.in_prior = true;
            self.relinearise();
        }
    }

    pub(crate) fn relinearise(&mut self) {
        (self.linearised, self.step) = (self.now, SVector::zeros());
    }

    pub(crate) fn apply(&mut self, step: &SVector<f64, N>) {
        self.now += step;
        self.step = self.now - self.linearised;
    }

    /// The step, where the prior speaks of it.
    pub(crate) fn step_in_prior(&self) -> Option<SVector<f64, N>> {
        self.in_prior.then_some(self.step)
    }
}
