//! Drives, `valuemap_core::drives`.

use numpy::{IntoPyArray, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use valuemap_core::drives::{self, Way};

use crate::arrays::{check_length, rows_of};

/// The camera centres (N, 3) of images by their quaternions (N, 4) and translations (N, 3).
#[pyfunction]
pub fn camera_centers<'py>(
    py: Python<'py>,
    cam_from_world_quat: PyReadonlyArray2<'py, f64>,
    cam_from_world_m: PyReadonlyArray2<'py, f64>,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let (quaternions, translations) = (rows_of::<4>(&cam_from_world_quat)?, rows_of::<3>(&cam_from_world_m)?);
    check_length("cam_from_world_m", translations.len(), quaternions.len())?;
    let centers: Vec<f64> =
        py.detach(|| quaternions.iter().zip(translations).flat_map(|(q, t)| drives::camera_center(q, t)).collect());
    centers.into_pyarray(py).reshape([quaternions.len(), 3])
}

/// Where (N) drives come back to where they have been.
#[pyfunction]
pub fn revisits<'py>(
    py: Python<'py>,
    place_m: PyReadonlyArray2<'py, f64>,
    drive: PyReadonlyArray1<'py, i64>,
    driven_m: PyReadonlyArray1<'py, f64>,
    near_m: PyReadonlyArray1<'py, f64>,
    away_m: PyReadonlyArray1<'py, f64>,
    ground: [usize; 2],
) -> PyResult<Bound<'py, PyArray1<bool>>> {
    if ground.iter().any(|&axis| axis > 2) {
        return Err(PyValueError::new_err("ground: expected two of the axes 0, 1, 2"));
    }
    let way = Way {
        place_m: rows_of(&place_m)?,
        drive: drive.as_slice()?,
        driven_m: driven_m.as_slice()?,
        near_m: near_m.as_slice()?,
        away_m: away_m.as_slice()?,
        ground,
    };
    let lengths = [way.drive.len(), way.driven_m.len(), way.near_m.len(), way.away_m.len()];
    lengths.iter().try_for_each(|&length| check_length("exposures", length, way.place_m.len()))?;
    Ok(py.detach(|| drives::revisits(&way)).into_pyarray(py))
}

/// Where (N) viewpoints begin along drives.
#[pyfunction]
pub fn viewpoint_openings<'py>(
    py: Python<'py>,
    place_m: PyReadonlyArray2<'py, f64>,
    begins: PyReadonlyArray1<'py, bool>,
    step_m: f64,
) -> PyResult<Bound<'py, PyArray1<bool>>> {
    let (places, begins) = (rows_of(&place_m)?, begins.as_slice()?);
    check_length("begins", begins.len(), places.len())?;
    Ok(py.detach(|| drives::viewpoint_openings(places, begins, step_m)).into_pyarray(py))
}
