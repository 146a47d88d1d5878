//! The border between Python and `valuemap-core`: arrays and errors across, no logic.
#![allow(clippy::needless_pass_by_value)] // Python hands its arguments over by value.

mod arrays;
mod drives;
mod robust;
mod run;

use std::sync::Arc;

use numpy::{
    IntoPyArray, PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use valuemap_core::evidence;
use valuemap_core::matrix_from_rows;
use valuemap_core::paper::hypothesis::PairCounts;
use valuemap_core::paper::select::Stop;
use valuemap_core::paper::vote::Candidate;
use valuemap_core::paper::{merge, partition, triangulate, vote};
use valuemap_core::ray::Ray;
use valuemap_core::viability::Viability;

use crate::arrays::{
    FARTHEST_M, Groups, candidates_from, check_finite, check_ranges, check_within, check_within_or_none, groups_of,
    matrices_of, points_of, rays_in, rows_of,
};
use crate::run::with_progress;

/// Many threads allocate small matrices and large columns all the time.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Classes are numbered below this: a table of what is learned of them has a row for each.
const MOST_CLASSES: u32 = 1 << 16;

/// Viewing rays, one a detection, copied once and used by every stage.
#[pyclass(frozen, module = "valuemap._core")]
pub struct Rays(Arc<valuemap_core::ray::Rays>);

impl Rays {
    fn core(&self) -> &Arc<valuemap_core::ray::Rays> {
        &self.0
    }
}

#[pymethods]
impl Rays {
    #[new]
    fn new(
        residual_from_cam: PyReadonlyArray3<'_, f64>,
        direction_in_cam: PyReadonlyArray2<'_, f64>,
        image: PyReadonlyArray1<'_, u32>,
        class: PyReadonlyArray1<'_, u32>,
        cam_from_world: PyReadonlyArray3<'_, f64>,
        center_in_world_m: PyReadonlyArray2<'_, f64>,
    ) -> PyResult<Self> {
        let matrices = matrices_of("residual_from_cam", &residual_from_cam)?;
        let directions = rows_of(&direction_in_cam)?;
        let rotations = matrices_of("cam_from_world", &cam_from_world)?;
        let centers = rows_of(&center_in_world_m)?;
        // Where a camera has no ray for a pixel, matrix and direction are NaN.
        check_within_or_none("residual_from_cam", matrices.as_flattened(), FARTHEST_M)?;
        check_within_or_none("direction_in_cam", directions.as_flattened(), FARTHEST_M)?;
        check_within("cam_from_world", rotations.as_flattened(), FARTHEST_M)?;
        check_within("center_in_world_m", centers.as_flattened(), FARTHEST_M)?;
        let (image, class) = (image.as_slice()?.to_vec(), class.as_slice()?.to_vec());
        let lengths = [directions.len(), image.len(), class.len()];
        if lengths.iter().any(|&length| length != matrices.len()) {
            return Err(PyValueError::new_err("rays: all arrays must have one row a ray"));
        }
        if rotations.len() != centers.len() || image.iter().any(|&image| image as usize >= centers.len()) {
            return Err(PyValueError::new_err("rays: every image must have a pose"));
        }
        if class.iter().any(|&class| class >= MOST_CLASSES) {
            return Err(PyValueError::new_err(format!("class: expected numbers below {MOST_CLASSES}")));
        }
        let of_ray = |((matrix, &direction), &image): ((&[f64; 9], &[f64; 3]), &u32)| {
            let cam_from_world = matrix_from_rows(&rotations[image as usize]);
            Ray::of_camera(&matrix_from_rows(matrix), direction.into(), &cam_from_world, centers[image as usize].into())
        };
        let rays = matrices.iter().zip(directions).zip(&image).map(of_ray).collect();
        Ok(Self(Arc::new(valuemap_core::ray::Rays { rays, image, class })))
    }

    /// M of every ray in the world, (N, 3, 3).
    fn residual_from_world<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f64>>> {
        // Column by column.
        let transposed = self.0.rays.iter().map(|ray| ray.residual_from_world.transpose());
        arrays::matrix(py, transposed)?.reshape([self.0.rays.len(), 3, 3])
    }

    /// The camera centre of every ray in the world, m, (N, 3).
    fn center_in_world_m<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::matrix(py, self.0.rays.iter().map(|ray| ray.center))
    }

    /// The unit direction of every ray in the world, (N, 3).
    fn direction_in_world<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::matrix(py, self.0.rays.iter().map(|ray| ray.direction))
    }

    /// The same rays in a world whose lengths are in units of so many metres.
    fn in_units(&self, unit_m: f64) -> PyResult<Self> {
        arrays::check_within("unit_m", &[unit_m, 1.0 / unit_m], arrays::FARTHEST_M)?;
        let rays = self.0.rays.iter().map(|ray| valuemap_core::ray::Ray { center: ray.center / unit_m, ..*ray });
        Ok(Self(Arc::new(valuemap_core::ray::Rays { rays: rays.collect(), ..(*self.0).clone() })))
    }

    fn __len__(&self) -> usize {
        self.0.rays.len()
    }
}

/// The cluster of each image, `valuemap_core::paper::partition`.
#[pyfunction(name = "partition")]
fn partition_images<'py>(
    py: Python<'py>,
    center_in_world_m: PyReadonlyArray2<'py, f64>,
    cluster_radius_m: f64,
) -> PyResult<Bound<'py, PyArray1<u32>>> {
    let centers = rows_of(&center_in_world_m)?;
    check_within("center_in_world_m", centers.as_flattened(), FARTHEST_M)?;
    check_finite("cluster_radius_m", &[cluster_radius_m])?;
    Ok(py.detach(|| partition::partition(centers, cluster_radius_m)).into_pyarray(py))
}

/// Points, their groups of voters, the cluster of each, and the counts of pairs.
type Voted<'py> = (Bound<'py, PyArray2<f64>>, Groups<'py>, Bound<'py, PyArray1<u32>>, Bound<'py, PyDict>);

/// Algorithm 1 in every cluster, `valuemap_core::paper::vote`.
#[pyfunction(name = "vote")]
#[pyo3(signature = (rays, cluster, *, max_reprojection_error_px, min_parallax_rad, min_range_m, max_range_m,
    min_vote_ratio, min_votes, threads, progress))]
#[allow(clippy::too_many_arguments)] // The settings by name, as Python sees them.
fn vote_in_clusters<'py>(
    py: Python<'py>,
    rays: &Rays,
    cluster: PyReadonlyArray1<'py, u32>,
    max_reprojection_error_px: f64,
    min_parallax_rad: f64,
    min_range_m: f64,
    max_range_m: f64,
    min_vote_ratio: f64,
    min_votes: u32,
    threads: usize,
    progress: &Bound<'py, PyAny>,
) -> PyResult<Voted<'py>> {
    let cluster = cluster.as_slice()?;
    if cluster.len() != rays.0.rays.len() {
        return Err(PyValueError::new_err("vote: one cluster a ray is needed"));
    }
    check_finite("settings", &[max_reprojection_error_px, min_parallax_rad, min_range_m, max_range_m, min_vote_ratio])?;
    check_ranges(min_range_m, max_range_m)?;
    let viability = Viability { max_reprojection_error_px, min_parallax_rad, min_range_m, max_range_m };
    let stop = Stop { min_vote_ratio, min_votes };
    let total = vote::count_units(&rays.0, cluster);
    let (candidates, counts) = with_progress(py, threads, total, progress, |progress| {
        vote::vote(&rays.0, cluster, &viability, &stop, progress)
    })?;
    let cluster: Vec<u32> = candidates.iter().map(|candidate| candidate.clusters[0]).collect();
    Ok((
        points_of(py, &candidates)?,
        groups_of(py, candidates.iter().map(|candidate| &candidate.voters[..])),
        cluster.into_pyarray(py),
        counts_of(py, &counts)?,
    ))
}

fn counts_of<'py>(py: Python<'py>, counts: &PairCounts) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    dict.set_item("pairs", counts.pairs)?;
    dict.set_item("pairs_rejected_parallax", counts.parallax)?;
    dict.set_item("pairs_rejected_reprojection", counts.reprojection)?;
    dict.set_item("pairs_rejected_behind", counts.behind)?;
    dict.set_item("pairs_rejected_range", counts.range)?;
    dict.set_item("hypotheses", counts.hypotheses)?;
    Ok(dict)
}

/// Merge labels of different clusters, `valuemap_core::paper::merge`.
#[pyfunction(name = "merge")]
fn merge_labels<'py>(
    py: Python<'py>,
    rays: &Rays,
    point_in_world_m: PyReadonlyArray2<'py, f64>,
    voter_offsets: PyReadonlyArray1<'py, i64>,
    voters: PyReadonlyArray1<'py, u32>,
    cluster: PyReadonlyArray1<'py, u32>,
    merge_radius_m: f64,
) -> PyResult<(Bound<'py, PyArray2<f64>>, Groups<'py>)> {
    check_finite("merge_radius_m", &[merge_radius_m])?;
    let candidates: Vec<Candidate> = candidates_from(
        rays.0.rays.len(),
        rows_of(&point_in_world_m)?,
        voter_offsets.as_slice()?,
        voters.as_slice()?,
        cluster.as_slice()?,
    )?;
    let merged = py.detach(|| merge::merge(&rays.0, candidates, merge_radius_m));
    Ok((points_of(py, &merged)?, groups_of(py, merged.iter().map(|candidate| &candidate.voters[..]))))
}

/// Covariances for 1 px detections (N, 9), `valuemap_core::paper::triangulate::unit_covariance`.
#[pyfunction]
fn unit_covariance<'py>(
    py: Python<'py>,
    rays: &Rays,
    point_in_world_m: PyReadonlyArray2<'py, f64>,
    voter_offsets: PyReadonlyArray1<'py, i64>,
    voters: PyReadonlyArray1<'py, u32>,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let points = rows_of(&point_in_world_m)?;
    let groups = rays_in(rays.0.rays.len(), points.len(), voter_offsets.as_slice()?, voters.as_slice()?)?;
    let of_point = |(&point, voters): (&[f64; 3], &[u32])| {
        let supporters = voters.iter().map(|&ray| &rays.0.rays[ray as usize]);
        triangulate::unit_covariance(supporters, &point.into())
    };
    arrays::matrix(py, points.iter().zip(groups).map(of_point))
}

/// Reprojection errors (M) in px and metres a pixel (M, 2) of the voters, and the largest angle (N) between them,
/// `valuemap_core::evidence`.
type Seen<'py> = (Bound<'py, PyArray1<f64>>, Bound<'py, PyArray2<f64>>, Bound<'py, PyArray1<f64>>);

/// What the voters of points see.
#[pyfunction]
fn see<'py>(
    py: Python<'py>,
    rays: &Rays,
    point_in_world_m: PyReadonlyArray2<'py, f64>,
    voter_offsets: PyReadonlyArray1<'py, i64>,
    voters: PyReadonlyArray1<'py, u32>,
) -> PyResult<Seen<'py>> {
    let points = rows_of(&point_in_world_m)?;
    let voters = voters.as_slice()?;
    let groups = rays_in(rays.0.rays.len(), points.len(), voter_offsets.as_slice()?, voters)?;
    let ray = |number: u32| &rays.0.rays[number as usize];
    let mut residual_px = Vec::with_capacity(voters.len());
    let mut metres_per_px = Vec::with_capacity(2 * voters.len());
    let mut angles = Vec::with_capacity(points.len());
    for (&point, voters) in points.iter().zip(groups) {
        let point = point.into();
        for sight in voters.iter().map(|&voter| evidence::sight(ray(voter), &point)) {
            residual_px.push(sight.residual_px);
            metres_per_px.extend(sight.metres_per_px);
        }
        angles.push(evidence::max_angle(voters.iter().map(|&voter| ray(voter)), &point));
    }
    let metres_per_px = metres_per_px.into_pyarray(py).reshape([residual_px.len(), 2])?;
    Ok((residual_px.into_pyarray(py), metres_per_px, angles.into_pyarray(py)))
}

/// The median of each group of values, `valuemap_core::evidence::median`.
#[pyfunction]
fn medians<'py>(
    py: Python<'py>,
    values: PyReadonlyArray1<'py, f64>,
    offsets: PyReadonlyArray1<'py, i64>,
) -> PyResult<Bound<'py, PyArray1<f64>>> {
    let offsets = offsets.as_slice()?;
    let groups = arrays::split(offsets.len().saturating_sub(1), offsets, values.as_slice()?)?;
    let medians: Vec<f64> = groups.into_iter().map(|group| evidence::median(&mut group.to_vec())).collect();
    Ok(medians.into_pyarray(py))
}

/// The names of the parts of the robust method that can be left out, `valuemap_core::robust::parts::Part`.
#[pyfunction]
fn parts() -> Vec<&'static str> {
    valuemap_core::robust::parts::Part::ALL.iter().map(|(_, name)| *name).collect()
}

#[pymodule]
mod _core {
    use valuemap_core::robust::model::ClassModel;

    #[pymodule_export]
    use super::drives::{camera_centers, revisits, viewpoint_openings};
    #[pymodule_export]
    use super::robust::{Scene, calibrate, find_labels, misfits, sides};
    #[pymodule_export]
    const CLASS_FIELDS: [(&str, usize); ClassModel::FIELDS.len()] = ClassModel::FIELDS;
    #[pymodule_export]
    const CALIBRATION_STEPS: usize = valuemap_core::robust::calibrate::CALIBRATION_STEPS;
    #[pymodule_export]
    const FARTHEST_M: f64 = super::arrays::FARTHEST_M;
    #[pymodule_export]
    const MISFIT_STEPS: usize = valuemap_core::robust::calibrate::likeliest::MISFIT_STEPS;
    #[pymodule_export]
    const SEARCH_STEPS: usize = valuemap_core::robust::search::SEARCH_STEPS;
    #[pymodule_export]
    const STEPS_OF_ONCE: usize = valuemap_core::robust::search::STEPS_OF_ONCE;
    #[pymodule_export]
    use super::{Rays, medians, merge_labels, partition_images, parts, see, unit_covariance, vote_in_clusters};
}
