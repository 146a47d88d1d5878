//! The robust method across the border.

use std::sync::Arc;

use numpy::{IntoPyArray, PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use valuemap_core::hypothesis::Viability;
use valuemap_core::robust::calibrate::Known;
use valuemap_core::robust::noise::Noise;
use valuemap_core::robust::scene::{Frustum, Scene as CoreScene, View, number_viewpoints};
use valuemap_core::robust::{Findings, Settings, Without, find, self_calibrate};

use crate::Rays;
use crate::arrays::{Groups, matrix, rows_of};
use crate::run::with_progress;

/// Rays with their boxes, and all images: what the robust method works on.
#[pyclass(frozen, module = "valuemap._core")]
pub struct Scene(CoreScene);

#[pymethods]
impl Scene {
    #[new]
    #[pyo3(signature = (rays, *, box_px, range_m, range_sigma_m, center_in_world_m, cam_from_world, camera, pass_code,
        position_sigma_m, rotation_sigma_rad, frustum_normals, solid_angle_sr, viewpoint_step_m))]
    #[allow(clippy::too_many_arguments)] // The columns by name, as Python sees them.
    fn new(
        rays: &Rays,
        box_px: PyReadonlyArray1<'_, f64>,
        range_m: PyReadonlyArray1<'_, f64>,
        range_sigma_m: PyReadonlyArray1<'_, f64>,
        center_in_world_m: PyReadonlyArray2<'_, f64>,
        cam_from_world: PyReadonlyArray3<'_, f64>,
        camera: PyReadonlyArray1<'_, u32>,
        pass_code: PyReadonlyArray1<'_, u32>,
        position_sigma_m: PyReadonlyArray1<'_, f64>,
        rotation_sigma_rad: PyReadonlyArray1<'_, f64>,
        frustum_normals: PyReadonlyArray3<'_, f64>,
        solid_angle_sr: PyReadonlyArray1<'_, f64>,
        viewpoint_step_m: f64,
    ) -> PyResult<Self> {
        let centers = rows_of(&center_in_world_m)?;
        let rotations = cam_from_world.as_slice()?.as_chunks::<9>().0;
        let (camera, pass) = (camera.as_slice()?, pass_code.as_slice()?);
        let (positions, turns) = (position_sigma_m.as_slice()?, rotation_sigma_rad.as_slice()?);
        let images = [rotations.len(), camera.len(), pass.len(), positions.len(), turns.len()];
        let solid_angles = solid_angle_sr.as_slice()?;
        let normals = frustum_normals.as_slice()?.as_chunks::<3>().0;
        if images.iter().any(|&length| length != centers.len()) || !normals.len().is_multiple_of(solid_angles.len()) {
            return Err(PyValueError::new_err("scene: one row an image and a camera is needed"));
        }
        let viewpoints = number_viewpoints(centers, pass, viewpoint_step_m);
        let views = (0..centers.len())
            .map(|i| View {
                center: centers[i].into(),
                cam_from_world: valuemap_core::matrix_from_rows(&rotations[i]),
                camera: camera[i],
                pass: pass[i],
                viewpoint: viewpoints[i].0,
                driven_m: viewpoints[i].1,
                position_sigma_m: positions[i],
                rotation_sigma_rad: turns[i],
            })
            .collect();
        let frusta = normals
            .chunks(normals.len() / solid_angles.len())
            .zip(solid_angles)
            .map(|(normals, &solid_angle_sr)| Frustum {
                normals: normals.iter().filter(|n| n[0].is_finite()).map(|&n| n.into()).collect(),
                solid_angle_sr,
            })
            .collect();
        Ok(Self(CoreScene {
            scale2: rays.core().rays.iter().map(valuemap_core::ray::Ray::pixels_per_unit2).collect(),
            rays: Arc::clone(rays.core()),
            box_px: box_px.as_slice()?.to_vec(),
            range_m: range_m.as_slice()?.to_vec(),
            range_sigma_m: range_sigma_m.as_slice()?.to_vec(),
            views,
            frusta,
        }))
    }
}

/// The fields of the core's `Noise`, in their order.
type NoiseValues = [f64; 6];

fn noise_of(
    [detection_px, box_share, position_m, rotation_rad, position_drift_m, rotation_drift_rad]: NoiseValues,
) -> Noise {
    Noise { detection_px, box_share, position_m, rotation_rad, position_drift_m, rotation_drift_rad }
}

/// Least parallax (rad), least and largest range (m), gate (sigmas), least votes, least existence; without polish, merge.
type SettingValues = (f64, f64, f64, f64, u32, f64, bool, bool);

fn settings_of(
    (min_parallax_rad, min_range_m, max_range_m, gate_sigmas, min_votes, min_existence, polish, merge): SettingValues,
) -> Settings {
    let viability = Viability { max_reprojection_error_px: f64::NAN, min_parallax_rad, min_range_m, max_range_m };
    Settings { viability, gate_sigmas, min_votes, min_existence, without: Without { polish, merge } }
}

/// Estimate the noise from the data, `valuemap_core::robust::self_calibrate`.
#[pyfunction]
pub fn calibrate_noise(
    py: Python<'_>,
    scene: &Scene,
    guess: NoiseValues,
    known: [bool; 3],
    settings: SettingValues,
    threads: usize,
    progress: &Bound<'_, PyAny>,
) -> PyResult<NoiseValues> {
    let settings = settings_of(settings);
    let known = Known { detection: known[0], position: known[1], rotation: known[2] };
    let noise = with_progress(py, threads, 0, progress, |progress| {
        self_calibrate(&scene.0, &noise_of(guess), known, &settings, progress)
    })?;
    Ok([
        noise.detection_px,
        noise.box_share,
        noise.position_m,
        noise.rotation_rad,
        noise.position_drift_m,
        noise.rotation_drift_rad,
    ])
}

/// Positions, voters, covariances (N, 9), existence, expected images, and counts.
type Found<'py> = (
    Bound<'py, PyArray2<f64>>,
    Groups<'py>,
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray1<f64>>,
    Bound<'py, PyArray1<i64>>,
    Bound<'py, PyDict>,
);

/// Find labels with a known noise, `valuemap_core::robust::find`.
#[pyfunction]
pub fn find_labels<'py>(
    py: Python<'py>,
    scene: &Scene,
    noise: NoiseValues,
    settings: SettingValues,
    threads: usize,
    progress: &Bound<'py, PyAny>,
) -> PyResult<Found<'py>> {
    let settings = settings_of(settings);
    let found = with_progress(py, threads, scene.0.views.len(), progress, |progress| {
        find(&scene.0, &noise_of(noise), &settings, progress)
    })?;
    let labels = || found.findings.iter().map(|finding| &finding.label);
    let mut offsets = vec![0_i64];
    let mut voters: Vec<u32> = Vec::new();
    for label in labels() {
        let start = voters.len();
        voters.extend(&label.voters);
        voters[start..].sort_unstable();
        offsets.push(voters.len() as i64);
    }
    let existence: Vec<f64> = found.findings.iter().map(|finding| finding.existence).collect();
    let expected: Vec<i64> = found.findings.iter().map(|finding| i64::from(finding.expected)).collect();
    Ok((
        matrix(py, labels().map(|label| label.estimate.point))?,
        (offsets.into_pyarray(py), voters.into_pyarray(py)),
        matrix(py, labels().map(|label| label.estimate.covariance))?,
        existence.into_pyarray(py),
        expected.into_pyarray(py),
        counts_of(py, &found)?,
    ))
}

fn counts_of<'py>(py: Python<'py>, found: &Findings) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    dict.set_item("nominations", found.tally.nominations)?;
    dict.set_item("labels_before_settling", found.tally.accepted)?;
    dict.set_item("labels_fused", found.tally.fused)?;
    dict.set_item("labels_rejected_outvoted", found.tally.outvoted)?;
    dict.set_item("labels_rejected_existence", found.tally.doubted)?;
    dict.set_item("recall", found.rates.recall)?;
    dict.set_item("recall_concentration", found.rates.concentration)?;
    dict.set_item("strays_per_image", found.strays_per_image)?;
    dict.set_item("variance_factor", found.variance_factor)?;
    Ok(dict)
}
