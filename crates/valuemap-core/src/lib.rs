//! The numeric core of valuemap: posed detections in, 3D labels out. No files, no clock, no printing.
//!
//! The method, in the order of the modules (Algorithm 1 of Dabisias, Ruffaldi, Grimmett and Ondruska, "VALUE: Large
//! Scale Voting-based Automatic Labelling for Urban Environments", ICRA 2018):
//!
//! 1. [`partition`]: images are split into clusters that are worked on alone and in parallel.
//! 2. [`hypothesis`]: in a cluster, every pair of rays of different images proposes a 3D point by
//!    [`two_view`] triangulation; pairs that see nothing together are dropped by reason.
//! 3. [`ballot`]: every hypothesis is projected into every image; the closest detection votes. The
//!    [`kernel`] tests a few thousand million projections a second; each candidate it finds is tested exactly.
//! 4. [`select`]: the hypothesis with most votes wins, its voters leave, and so on until support is too thin.
//! 5. [`triangulate`] refines each winner over all its voters.
//! 6. [`merge`]: labels of different clusters that stand for one object become one.
//!
//! [`drives`] puts images in order before. [`vote`] is steps 2 to 5 for all clusters. Everything is `f64` in the caller's world frame, but for the
//! kernel, which sees `f32` relative to the cluster's origin and errs only towards testing too much.
//! The result does not depend on the number of threads.

// The streets of the integration tests serve the unit tests too; they name the crate as its users do.
#[cfg(test)]
extern crate self as valuemap_core;
#[cfg(test)]
#[path = "../tests/street/mod.rs"]
mod street;

pub mod ballot;
pub mod drives;
pub mod evidence;
pub mod hypothesis;
pub mod kernel;
pub mod merge;
pub mod partition;
pub mod progress;
pub mod ray;
pub mod robust;
pub mod select;
pub mod triangulate;
pub mod two_view;
pub mod vote;

pub use nalgebra::{SMatrix, Vector3};

/// A 3x3 matrix of its numbers row by row.
#[must_use]
pub fn matrix_from_rows(rows: &[f64; 9]) -> nalgebra::Matrix3<f64> {
    nalgebra::Matrix3::from_row_slice(rows)
}
