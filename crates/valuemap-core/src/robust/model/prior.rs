//! Observations of a position besides the centres of its detections (sizes, ranges), as normal equations.

use nalgebra::{Matrix3, Vector3};

/// What sizes of boxes or a measured range say of a position, linearised at a point.
#[derive(Debug, Clone, Copy)]
pub struct Prior {
    /// Information, 1/m².
    pub information: Matrix3<f64>,
    /// Gradient of half the square, 1/m.
    pub gradient: Vector3<f64>,
    /// Squared errors in standard deviations, each by its weight.
    pub square: f64,
}
