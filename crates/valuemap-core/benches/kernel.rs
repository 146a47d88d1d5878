//! Tests a second of the voting kernel on one core: points against rays, all in cache, as in one cluster.

use std::hint::black_box;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use nalgebra::{Matrix3, Rotation3, Vector3};
use valuemap_core::kernel::{Gate, Gates, instruction_sets};
use valuemap_core::ray::Ray;

const RAYS: usize = 192;
const POINTS: usize = 1024;

fn scene() -> (Vec<Ray>, Vec<Vector3<f64>>) {
    // A low-discrepancy sequence: no random numbers needed to spread rays and points.
    let spread = |i: usize, step: f64| (i as f64 * step).fract();
    let rays = (0..RAYS)
        .map(|i| {
            let turn = Rotation3::from_euler_angles(0.0, spread(i, 0.618_034) - 0.5, 0.0);
            let intrinsics = Matrix3::new(500.0, 0.0, 0.0, 0.0, 500.0, 0.0, 0.0, 0.0, 1.0);
            Ray {
                residual_from_world: intrinsics * turn.matrix(),
                center: Vector3::new(spread(i, 0.754_878) * 40.0, 0.0, spread(i, 0.569_840) * 40.0),
                direction: turn.inverse() * Vector3::z(),
            }
        })
        .collect();
    let points = (0..POINTS)
        .map(|i| Vector3::new(spread(i, 0.819_173) * 60.0, spread(i, 0.671_044) * 6.0, spread(i, 0.549_700) * 60.0))
        .collect();
    (rays, points)
}

fn bench(criterion: &mut Criterion) {
    let (rays, points) = scene();
    let gate = Gate { radius_px: 6.0, floor_m2: 0.0 };
    let gates = Gates::new((0..).zip(&rays).map(|(lane, ray)| (lane, ray, gate)));
    let mut maybe = vec![0; POINTS * gates.words()];
    let mut sure = maybe.clone();
    let mut group = criterion.benchmark_group("kernel");
    group.throughput(Throughput::Elements((RAYS * POINTS) as u64));
    for (name, arch) in instruction_sets() {
        group.bench_function(name, |bencher| {
            bencher.iter(|| gates.test_on(arch, black_box(&points), black_box(&mut maybe), black_box(&mut sure)));
        });
    }
    group.finish();
}

criterion_group!(benches, bench);
criterion_main!(benches);
