//! Huber's loss: residuals that are larger than noise usually is count less, in proportion (Huber, "Robust estimation of a location parameter", 1964).

/// From so many sigmas on: 95 % efficient where errors are Gaussian at 1.345, more above. It is 99 % at 2.
pub const HUBER_SIGMAS: f64 = 2.0;

/// The weight of a residual, of which the square in sigmas is given.
#[inline]
#[must_use]
pub fn huber_weight(chi2: f64) -> f64 {
    (HUBER_SIGMAS / chi2.sqrt()).min(1.0)
}
