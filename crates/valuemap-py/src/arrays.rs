//! `NumPy` arrays to the core's types and back.

use numpy::{
    IntoPyArray, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray2, PyReadonlyArray3, PyUntypedArrayMethods,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use valuemap_core::paper::vote::Candidate;
use valuemap_core::{SMatrix, Vector3};

/// Groups of rays: offsets (N + 1) into the members, and the members.
pub type Groups<'py> = (Bound<'py, PyArray1<i64>>, Bound<'py, PyArray1<u32>>);

/// Groups of rays, one after the other.
pub fn groups_of<'py, 'a>(py: Python<'py>, groups: impl Iterator<Item = &'a [u32]>) -> Groups<'py> {
    let (mut offsets, mut members) = (vec![0_i64], Vec::new());
    for group in groups {
        members.extend_from_slice(group);
        offsets.push(members.len() as i64);
    }
    (offsets.into_pyarray(py), members.into_pyarray(py))
}

/// Rows of an (N, WIDTH) array, without a copy.
pub fn rows_of<'a, const WIDTH: usize>(array: &'a PyReadonlyArray2<'_, f64>) -> PyResult<&'a [[f64; WIDTH]]> {
    if array.shape()[1] != WIDTH {
        return Err(PyValueError::new_err(format!("expected an array of shape (N, {WIDTH})")));
    }
    Ok(array.as_slice()?.as_chunks().0)
}

/// Vectors or matrices, column by column, as the rows of an array of shape (N, width).
pub fn matrix<const ROWS: usize, const COLUMNS: usize>(
    py: Python<'_>,
    matrices: impl ExactSizeIterator<Item = SMatrix<f64, ROWS, COLUMNS>>,
) -> PyResult<Bound<'_, PyArray2<f64>>> {
    let (count, width) = (matrices.len(), ROWS * COLUMNS);
    let mut rows = Vec::with_capacity(count * width);
    matrices.for_each(|matrix| rows.extend_from_slice(matrix.as_slice()));
    rows.into_pyarray(py).reshape([count, width])
}

/// The first and the last offset, and all between, must be as `split` needs them.
fn are_offsets(count: usize, offsets: &[i64], members: usize) -> bool {
    offsets.len() == count + 1
        && offsets.first() == Some(&0)
        && offsets.last().is_some_and(|&last| usize::try_from(last) == Ok(members))
        && offsets.is_sorted()
}

/// The members of each group.
pub fn split<'a, T>(count: usize, offsets: &[i64], members: &'a [T]) -> PyResult<Vec<&'a [T]>> {
    let bad = || PyValueError::new_err("groups: offsets must rise from 0 to the number of members");
    if !are_offsets(count, offsets, members.len()) {
        return Err(bad());
    }
    let bounds = |i: usize| usize::try_from(offsets[i]).ok();
    (0..count).map(|i| members.get(bounds(i)?..bounds(i + 1)?)).collect::<Option<Vec<_>>>().ok_or_else(bad)
}

/// Members of groups of rays: each must be a ray.
pub fn rays_in<'a>(rays: usize, count: usize, offsets: &[i64], members: &'a [u32]) -> PyResult<Vec<&'a [u32]>> {
    if members.iter().any(|&ray| ray as usize >= rays) {
        return Err(PyValueError::new_err(format!("voters: expected rows of {rays} rays")));
    }
    split(count, offsets, members)
}

/// The column must have a value for each of `count` rows.
pub fn check_length(name: &str, found: usize, count: usize) -> PyResult<()> {
    if found == count {
        return Ok(());
    }
    Err(PyValueError::new_err(format!("{name}: expected {count} values, found {found}")))
}

/// All values must be finite numbers.
pub fn check_finite(name: &str, values: &[f64]) -> PyResult<()> {
    if values.iter().all(|value| value.is_finite()) {
        return Ok(());
    }
    Err(PyValueError::new_err(format!("{name}: expected finite numbers")))
}

/// No range is longer, m: the voting kernel counts in single precision.
const LONGEST_M: f64 = 1e6;
/// No greatest range is shorter, m: places are looked up in cubes of that size.
const SHORTEST_M: f64 = 1e-6;

/// The least and the largest range of objects must leave room between them.
pub fn check_ranges(min_range_m: f64, max_range_m: f64) -> PyResult<()> {
    if 0.0 <= min_range_m && min_range_m < max_range_m && (SHORTEST_M..=LONGEST_M).contains(&max_range_m) {
        return Ok(());
    }
    Err(PyValueError::new_err(format!(
        "settings: expected 0 <= min_range_m < max_range_m, and max_range_m from {SHORTEST_M} to {LONGEST_M}"
    )))
}

/// All values must be finite numbers, or NaN, which stands for none.
pub fn check_not_infinite(name: &str, values: &[f64]) -> PyResult<()> {
    if values.iter().all(|value| !value.is_infinite()) {
        return Ok(());
    }
    Err(PyValueError::new_err(format!("{name}: expected finite numbers, or NaN for none")))
}

/// No place is farther from the origin of its world, m: `valuemap.dataset` lets translations of 1e12 pass.
pub const FARTHEST_M: f64 = 2e12;

/// All values must be numbers of at most so much.
pub fn check_within(name: &str, values: &[f64], most: f64) -> PyResult<()> {
    if values.iter().all(|value| value.abs() <= most) {
        return Ok(());
    }
    Err(PyValueError::new_err(format!("{name}: expected numbers from -{most:e} to {most:e}")))
}

/// All values must be numbers of at most so much, or NaN, which stands for none.
pub fn check_within_or_none(name: &str, values: &[f64], most: f64) -> PyResult<()> {
    if values.iter().all(|value| value.is_nan() || value.abs() <= most) {
        return Ok(());
    }
    Err(PyValueError::new_err(format!("{name}: expected numbers from -{most:e} to {most:e}, or NaN for none")))
}

/// Matrices of an (N, 3, 3) array, without a copy.
pub fn matrices_of<'a>(name: &str, array: &'a PyReadonlyArray3<'_, f64>) -> PyResult<&'a [[f64; 9]]> {
    if array.shape()[1..] != [3, 3] {
        return Err(PyValueError::new_err(format!("{name}: expected an array of shape (N, 3, 3)")));
    }
    Ok(array.as_slice()?.as_chunks::<9>().0)
}

/// Candidates of points with groups of voters, each from one cluster.
pub fn candidates_from(
    rays: usize,
    points: &[[f64; 3]],
    offsets: &[i64],
    members: &[u32],
    cluster: &[u32],
) -> PyResult<Vec<Candidate>> {
    let groups = rays_in(rays, points.len(), offsets, members)?;
    check_finite("points", points.as_flattened())?;
    if cluster.len() != points.len() || groups.iter().any(|group| group.is_empty()) {
        return Err(PyValueError::new_err("candidates: one cluster and at least one voter a point are needed"));
    }
    Ok(points
        .iter()
        .zip(groups.iter().zip(cluster))
        .map(|(&point, (&voters, &cluster))| Candidate {
            point: Vector3::from(point),
            clusters: vec![cluster],
            voters: voters.to_vec(),
        })
        .collect())
}

/// Positions of candidates, (N, 3).
pub fn points_of<'py>(py: Python<'py>, candidates: &[Candidate]) -> PyResult<Bound<'py, PyArray2<f64>>> {
    matrix(py, candidates.iter().map(|candidate| candidate.point))
}
