//! Which pairs of detections may propose a point.

/// When a pair of detections proposes a point.
#[derive(Debug, Clone, Copy)]
pub struct Viability {
    /// Both reprojection errors must be below this, px (`d_max`).
    pub max_reprojection_error_px: f64,
    /// The two rays must differ by more than this, rad (`theta_min`).
    pub min_parallax_rad: f64,
    /// The point must be at least this far from both cameras, m.
    pub min_range_m: f64,
    /// The point must be at most this far from both cameras, m (`r_max`).
    pub max_range_m: f64,
}
