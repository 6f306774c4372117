//! Similarities along the chain of chunks.

use vidar_core::Sim3;

/// From "chunk k+1 → chunk k" to "chunk k+1 → chunk 0": `C₀ = S₀`, `Cₖ = Cₖ₋₁ ∘ Sₖ`.
pub fn accumulate(previous_from_next: &[Sim3]) -> Vec<Sim3> {
    previous_from_next
        .iter()
        .scan(Sim3::IDENTITY, |sum, step| {
            *sum = *sum * *step;
            Some(*sum)
        })
        .collect()
}

/// The transform between the two chunks of a loop, by a loop chunk that shares frames with both: `b_from_a = b_from_loop ∘ a_from_loop⁻¹`.
pub fn loop_constraint(a_from_loop: &Sim3, b_from_loop: &Sim3) -> Sim3 {
    *b_from_loop * vidar_core::LieGroup::inverse(a_from_loop)
}
