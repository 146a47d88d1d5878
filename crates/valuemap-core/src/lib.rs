//! The numeric core of valuemap: posed detections in, 3D labels out. No files, no clock, no printing.
//!
//! Two methods stand side by side: [`paper`], as published, and [`robust`], the default. Both work on rays ([`ray`]), which meet by the rules of
//! [`viability`] and are found by the [`kernel`]. [`drives`] puts images in order before, and [`evidence`] tells what speaks for a label after.
//!
//! Everything is `f64` in the caller's world frame, but for the kernel, which sees `f32` relative to an origin nearby and errs only towards testing too
//! much. The result does not depend on the number of threads.

#[cfg(test)]
mod tests;
#[cfg(test)]
use tests::street;

pub mod drives;
pub mod evidence;
pub mod kernel;
pub mod paper;
pub mod progress;
pub mod ray;
pub mod robust;
pub mod viability;

pub use nalgebra::{SMatrix, Vector3};

/// A 3x3 matrix of its numbers row by row.
#[must_use]
pub fn matrix_from_rows(rows: &[f64; 9]) -> nalgebra::Matrix3<f64> {
    nalgebra::Matrix3::from_row_slice(rows)
}
