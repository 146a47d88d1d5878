//! Settings of the robust method.

use crate::robust::parts::{Part, Without};
use crate::viability::Viability;

/// What a map is made with.
#[derive(Debug, Clone, Copy)]
pub struct Settings {
    /// Which pairs propose points; the error in pixels is not used.
    pub viability: Viability,
    /// The gate, in sigmas.
    pub gate_sigmas: f64,
    /// Labels with fewer voters are dropped.
    pub min_votes: usize,
    /// Objects of which heights are known need no more than so many.
    pub least_votes: usize,
    /// Labels that exist with a smaller probability are dropped.
    pub min_existence: f64,
    /// Parts that are left out, to see what they are worth.
    pub without: Without,
}

impl Settings {
    /// Logarithm of the density of objects where nothing tells it, 1/m³: one per cube as wide as the range.
    #[must_use]
    pub fn ln_births_per_m3(&self) -> f64 {
        -3.0 * self.viability.max_range_m.ln()
    }

    /// The gate, in squared sigmas.
    #[inline]
    #[must_use]
    pub fn gate_chi2(&self) -> f64 {
        self.gate_sigmas * self.gate_sigmas
    }

    /// Whether a part of the method is in use.
    #[inline]
    #[must_use]
    pub const fn has(&self, part: Part) -> bool {
        !self.without.has(part)
    }
}
