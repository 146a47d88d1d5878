//! The robust method across the border.

use std::sync::Arc;

use numpy::{
    IntoPyArray, PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3, PyUntypedArrayMethods,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use valuemap_core::robust::calibrate::likeliest;
use valuemap_core::robust::calibrate::{Calibration, self_calibrate};
use valuemap_core::robust::energy::sides::of_directions;
use valuemap_core::robust::model::ClassModel;
use valuemap_core::robust::model::confusions::Confusions;
use valuemap_core::robust::noise::Known;
use valuemap_core::robust::noise::Noise;
use valuemap_core::robust::parts::Without;
use valuemap_core::robust::scene::{Frustum, Scene as CoreScene, View};
use valuemap_core::robust::settings::Settings;
use valuemap_core::robust::{Findings, find};
use valuemap_core::viability::Viability;

use crate::Rays;
use crate::arrays::{
    FARTHEST_M, Groups, check_finite, check_length, check_not_infinite, check_ranges, check_within,
    check_within_or_none, groups_of, matrices_of, matrix, rows_of,
};
use crate::run::with_progress;

/// Rays with their boxes, and all images: what the robust method works on.
#[pyclass(frozen, module = "valuemap._core")]
pub struct Scene(CoreScene);

#[pymethods]
impl Scene {
    #[new]
    #[pyo3(signature = (rays, *, box_px, score, range_m, range_sigma_m, center_in_world_m, cam_from_world, camera, pass_code,
        viewpoint, driven_m, position_sigma_m, rotation_sigma_rad, frustum_normals, solid_angle_sr))]
    #[allow(clippy::too_many_arguments)] // The columns by name, as Python sees them.
    fn new(
        rays: &Rays,
        box_px: PyReadonlyArray1<'_, f64>,
        score: PyReadonlyArray1<'_, f64>,
        range_m: PyReadonlyArray1<'_, f64>,
        range_sigma_m: PyReadonlyArray1<'_, f64>,
        center_in_world_m: PyReadonlyArray2<'_, f64>,
        cam_from_world: PyReadonlyArray3<'_, f64>,
        camera: PyReadonlyArray1<'_, u32>,
        pass_code: PyReadonlyArray1<'_, u32>,
        viewpoint: PyReadonlyArray1<'_, u32>,
        driven_m: PyReadonlyArray1<'_, f64>,
        position_sigma_m: PyReadonlyArray1<'_, f64>,
        rotation_sigma_rad: PyReadonlyArray1<'_, f64>,
        frustum_normals: PyReadonlyArray3<'_, f64>,
        solid_angle_sr: PyReadonlyArray1<'_, f64>,
    ) -> PyResult<Self> {
        let centers = rows_of(&center_in_world_m)?;
        let rotations = matrices_of("cam_from_world", &cam_from_world)?;
        let (camera, pass) = (camera.as_slice()?, pass_code.as_slice()?);
        let (viewpoint, driven_m) = (viewpoint.as_slice()?, driven_m.as_slice()?);
        let (positions, turns) = (position_sigma_m.as_slice()?, rotation_sigma_rad.as_slice()?);
        let images = centers.len();
        check_length("cam_from_world", rotations.len(), images)?;
        check_length("camera", camera.len(), images)?;
        check_length("pass_code", pass.len(), images)?;
        check_length("viewpoint", viewpoint.len(), images)?;
        check_length("driven_m", driven_m.len(), images)?;
        check_length("position_sigma_m", positions.len(), images)?;
        check_length("rotation_sigma_rad", turns.len(), images)?;
        check_within("center_in_world_m", centers.as_flattened(), FARTHEST_M)?;
        check_within("cam_from_world", rotations.as_flattened(), FARTHEST_M)?;
        check_within("driven_m", driven_m, FARTHEST_M)?;
        check_not_infinite("position_sigma_m", positions)?;
        check_not_infinite("rotation_sigma_rad", turns)?;
        let solid_angles = solid_angle_sr.as_slice()?;
        check_within("solid_angle_sr", solid_angles, FARTHEST_M)?;
        let planes = match *frustum_normals.shape() {
            [cameras, planes, 3] if cameras == solid_angles.len() && planes > 0 => planes,
            _ => return Err(PyValueError::new_err("frustum_normals: expected shape (cameras, planes, 3)")),
        };
        let normals = frustum_normals.as_slice()?.as_chunks::<3>().0;
        check_within_or_none("frustum_normals", normals.as_flattened(), FARTHEST_M)?;
        if camera.iter().any(|&camera| camera as usize >= solid_angles.len()) {
            return Err(PyValueError::new_err(format!("camera: expected rows of {} cameras", solid_angles.len())));
        }
        let core = rays.core();
        if core.image.iter().any(|&image| image as usize >= images) {
            return Err(PyValueError::new_err(format!("rays: expected rays of {images} images")));
        }
        let (box_px, range_m, range_sigma_m) = (box_px.as_slice()?, range_m.as_slice()?, range_sigma_m.as_slice()?);
        check_length("box_px", box_px.len(), core.rays.len())?;
        check_length("range_m", range_m.len(), core.rays.len())?;
        check_length("range_sigma_m", range_sigma_m.len(), core.rays.len())?;
        check_length("score", score.as_slice()?.len(), core.rays.len())?;
        check_within("box_px", box_px, FARTHEST_M)?;
        check_not_infinite("range_m", range_m)?;
        check_not_infinite("range_sigma_m", range_sigma_m)?;
        let views = (0..centers.len())
            .map(|i| View {
                center: centers[i].into(),
                cam_from_world: valuemap_core::matrix_from_rows(&rotations[i]),
                camera: camera[i],
                pass: pass[i],
                viewpoint: viewpoint[i],
                driven_m: driven_m[i],
                position_sigma_m: positions[i],
                rotation_sigma_rad: turns[i],
            })
            .collect();
        let frusta = normals
            .chunks(planes)
            .zip(solid_angles)
            .map(|(normals, &solid_angle_sr)| Frustum {
                normals: normals.iter().filter(|n| n[0].is_finite()).map(|&n| n.into()).collect(),
                solid_angle_sr,
                blind: None,
            })
            .collect();
        let mut scene = CoreScene {
            scale2: rays.core().rays.iter().map(valuemap_core::ray::Ray::pixels_per_unit2).collect(),
            rays: Arc::clone(rays.core()),
            box_px: box_px.to_vec(),
            score: score.as_slice()?.to_vec(),
            range_m: range_m.to_vec(),
            range_sigma_m: range_sigma_m.to_vec(),
            views,
            frusta,
        };
        scene.find_blind_sides();
        Ok(Self(scene))
    }
}

/// The fields of the core's `Noise`, in their order.
type NoiseValues = [f64; 10];

fn values_of(noise: &Noise) -> NoiseValues {
    [
        noise.detection_px,
        noise.box_share,
        noise.position_m,
        noise.rotation_rad,
        noise.position_segment_m,
        noise.rotation_segment_rad,
        noise.position_drift_m,
        noise.rotation_drift_rad,
        noise.side_m,
        noise.look_correlation,
    ]
}

fn noise_of(values: NoiseValues) -> PyResult<Noise> {
    check_within("noise", &values, FARTHEST_M)?;
    if values.iter().any(|&value| value < 0.0) || values[0] == 0.0 {
        return Err(PyValueError::new_err("noise: expected standard deviations, that of a detection above 0"));
    }
    if values[9] >= 1.0 {
        return Err(PyValueError::new_err("noise: expected a correlation of looks below 1"));
    }
    let [
        detection_px,
        box_share,
        position_m,
        rotation_rad,
        position_segment_m,
        rotation_segment_rad,
        position_drift_m,
        rotation_drift_rad,
        side_m,
        look_correlation,
    ] = values;
    Ok(Noise {
        detection_px,
        box_share,
        position_m,
        rotation_rad,
        position_segment_m,
        rotation_segment_rad,
        position_drift_m,
        rotation_drift_rad,
        side_m,
        look_correlation,
    })
}

/// No gate is wider, sigmas: what it lets in is counted in whole parts of a sigma.
const WIDEST_GATE: f64 = 1e3;
/// Nothing that is learned is larger: logarithms, sizes and ranges.
const LARGEST_LEARNED: f64 = 1e6;
/// Least parallax (rad), least and largest range (m), gate (sigmas), least votes without and with heights, least existence; the
/// names of parts that are left out.
type SettingValues = (f64, f64, f64, f64, u32, u32, f64, Vec<String>);

fn settings_of(
    (min_parallax_rad, min_range_m, max_range_m, gate_sigmas, min_votes, least_votes, min_existence, without): SettingValues,
) -> PyResult<Settings> {
    check_finite("settings", &[min_parallax_rad, min_range_m, max_range_m, gate_sigmas, min_existence])?;
    check_ranges(min_range_m, max_range_m)?;
    if !(gate_sigmas > 0.0 && gate_sigmas <= WIDEST_GATE) {
        return Err(PyValueError::new_err(format!("settings: expected gate_sigmas above 0 and up to {WIDEST_GATE}")));
    }
    let viability = Viability { max_reprojection_error_px: f64::NAN, min_parallax_rad, min_range_m, max_range_m };
    let without = Without::named(&without)
        .map_err(|name| PyValueError::new_err(format!("settings: no part of the method is called {name:?}")))?;
    Ok(Settings {
        viability,
        gate_sigmas,
        min_votes: min_votes as usize,
        least_votes: least_votes as usize,
        min_existence,
        without,
    })
}

/// A calibration: the noise, that of covariances, whether all moves pay, numbers of each class where anything is known of it, those of all classes
/// together, and, of the detections of each class, which others some are said to be of, with their shares.
type CalibrationValues = (NoiseValues, NoiseValues, bool, Vec<Option<Vec<f64>>>, Vec<f64>, Vec<Vec<(u32, f64)>>);

fn calibration_of(
    (noise, noise_of_covariances, is_deep, classes, pooled, shares): CalibrationValues,
) -> PyResult<Calibration> {
    let of = |row: Vec<f64>| {
        // Edges of steps may be infinite.
        let finite: Vec<f64> = row.iter().copied().filter(|number| !number.is_infinite()).collect();
        check_within_or_none("calibration", &finite, LARGEST_LEARNED)?;
        ClassModel::from_row(&row).ok_or_else(|| {
            PyValueError::new_err("calibration: expected as many numbers of a class as calibrate returns")
        })
    };
    let is_share = |row: &Vec<(u32, f64)>| row.iter().all(|(_, share)| (0.0..=1.0).contains(share));
    if !shares.iter().all(is_share) {
        return Err(PyValueError::new_err("calibration: expected shares of confused detections between 0 and 1"));
    }
    Ok(Calibration {
        confusions: Confusions::of_shares(shares),
        noise: noise_of(noise)?,
        noise_of_covariances: noise_of(noise_of_covariances)?,
        is_deep,
        classes: classes.into_iter().map(|row| row.map(of).transpose()).collect::<PyResult<_>>()?,
        pooled: of(pooled)?,
    })
}

/// What is known of the noise: detection, position, rotation, and what detections are off by at least, px.
fn known_of(([detection, position, rotation], least_px): ([bool; 3], f64)) -> PyResult<Known> {
    check_within("least_px", &[least_px], FARTHEST_M)?;
    if least_px < 0.0 {
        return Err(PyValueError::new_err("least_px: expected 0 or more"));
    }
    Ok(Known { detection, position, rotation, least_px })
}

/// Estimate the noise from the data and learn the classes, `valuemap_core::robust::calibrate::self_calibrate`: also the objects of the map that the
/// classes are learned from, their positions and voters.
#[pyfunction]
#[allow(clippy::too_many_arguments)]
pub fn calibrate<'py>(
    py: Python<'py>,
    scene: &Scene,
    guess: NoiseValues,
    known: ([bool; 3], f64),
    settings: SettingValues,
    is_part: bool,
    sought: Option<NoiseValues>,
    threads: usize,
    progress: &Bound<'_, PyAny>,
) -> PyResult<(CalibrationValues, Bound<'py, PyArray2<f64>>, Groups<'py>)> {
    let settings = settings_of(settings)?;
    let guess = noise_of(guess)?;
    let known = known_of(known)?;
    let sought = sought.map(noise_of).transpose()?;
    let (found, map) = with_progress(py, threads, 0, progress, |progress| {
        self_calibrate(&scene.0, &guess, known, &settings, is_part, sought, progress)
    })?;
    let classes = found.classes.iter().map(|class| class.as_ref().map(ClassModel::to_row)).collect();
    let calibration = (
        values_of(&found.noise),
        values_of(&found.noise_of_covariances),
        found.is_deep,
        classes,
        found.pooled.to_row(),
        found.confusions.shares().to_vec(),
    );
    let points = matrix(py, map.iter().map(|(_, point)| *point))?;
    Ok((calibration, points, groups_of(py, map.iter().map(|(votes, _)| &votes[..]))))
}

/// How badly the same rays fit in two scenes, how many they are, and the noise that was sought in the first one,
/// `valuemap_core::robust::calibrate::likeliest::misfits`.
#[pyfunction]
#[allow(clippy::too_many_arguments)]
pub fn misfits<'py>(
    py: Python<'py>,
    scenes: (PyRef<'py, Scene>, PyRef<'py, Scene>),
    second_of_first: PyReadonlyArray1<'py, u32>,
    guess: NoiseValues,
    known: ([bool; 3], f64),
    settings: SettingValues,
    threads: usize,
    progress: &Bound<'py, PyAny>,
) -> PyResult<([f64; 2], usize, Option<NoiseValues>)> {
    let settings = settings_of(settings)?;
    let guess = noise_of(guess)?;
    let known = known_of(known)?;
    let scenes = [&scenes.0.0, &scenes.1.0];
    let numbers = second_of_first.as_slice()?;
    let mut sorted = numbers.to_vec();
    sorted.sort_unstable();
    if scenes.iter().any(|scene| scene.rays.rays.len() != numbers.len())
        || !sorted.into_iter().eq(0..numbers.len() as u32)
    {
        return Err(PyValueError::new_err("second_of_first: expected each ray of two scenes of the same rays once"));
    }
    let found = with_progress(py, threads, 0, progress, |progress| {
        likeliest::misfits(scenes, numbers, &guess, known, &settings, progress)
    })?;
    Ok((found.values, found.rays, found.of_first.map(|noise| values_of(&noise))))
}

/// Positions, classes, voters, covariances (N, 9), existence, expected images, and counts.
type Found<'py> = (
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray1<u32>>,
    Groups<'py>,
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray1<f64>>,
    Bound<'py, PyArray1<i64>>,
    Bound<'py, PyDict>,
);

/// Find labels with what is estimated once, `valuemap_core::robust::find`.
#[pyfunction]
pub fn find_labels<'py>(
    py: Python<'py>,
    scene: &Scene,
    calibration: CalibrationValues,
    settings: SettingValues,
    threads: usize,
    progress: &Bound<'py, PyAny>,
) -> PyResult<Found<'py>> {
    let settings = settings_of(settings)?;
    let calibration = calibration_of(calibration)?;
    let found = with_progress(py, threads, scene.0.views.len(), progress, |progress| {
        find(&scene.0, &calibration, &settings, progress)
    })?;
    let labels = || found.findings.iter();
    let existence: Vec<f64> = found.findings.iter().map(|finding| finding.existence).collect();
    let expected: Vec<i64> = found.findings.iter().map(|finding| i64::from(finding.expected)).collect();
    let class: Vec<u32> = labels().map(|label| label.class).collect();
    Ok((
        matrix(py, labels().map(|label| label.estimate.point))?,
        class.into_pyarray(py),
        groups_of(py, labels().map(|label| &label.votes[..])),
        matrix(py, labels().map(|label| label.estimate.covariance))?,
        existence.into_pyarray(py),
        expected.into_pyarray(py),
        counts_of(py, &found)?,
    ))
}

fn counts_of<'py>(py: Python<'py>, found: &Findings) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    dict.set_item("hypotheses", found.tally.hypotheses)?;
    dict.set_item("births", found.tally.births)?;
    dict.set_item("deaths", found.tally.deaths)?;
    dict.set_item("energy", found.energy)?;
    dict.set_item("recall", found.rates.recall)?;
    dict.set_item("recall_concentration", found.rates.concentration)?;
    dict.set_item("clutter_per_image", found.clutter_per_image)?;
    dict.set_item("variance_factor", found.variance_factor)?;
    Ok(dict)
}

/// The side that each visit (V) of some objects looks from, numbered from 0 for each object, whose visits follow each other; `direction` (V, 3) is that
/// of its rays, of any length. `valuemap_core::robust::energy::sides`.
#[pyfunction]
pub fn sides<'py>(
    py: Python<'py>,
    object: PyReadonlyArray1<'py, u32>,
    direction: PyReadonlyArray2<'py, f64>,
) -> PyResult<Bound<'py, PyArray1<u32>>> {
    let (object, directions) = (object.as_slice()?, rows_of(&direction)?);
    if object.len() != directions.len() {
        return Err(PyValueError::new_err("sides: expected as many directions as visits"));
    }
    let mut found = vec![0; object.len()];
    let mut first = 0;
    for visits in object.chunk_by(|a, b| a == b) {
        let directions = directions[first..first + visits.len()].iter().map(|&direction| direction.into());
        for (number, side) in (0..).zip(of_directions(directions)) {
            for visit in side {
                found[first + visit as usize] = number;
            }
        }
        first += visits.len();
    }
    Ok(found.into_pyarray(py))
}
