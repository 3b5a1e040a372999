//! Reading files whose time must grow with their size alone: time per face, at three sizes. A reader that is quadratic
//! somewhere shows it here as a time per face that doubles with the size.

use bakelite::SceneData;
use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use std::fmt::Write;
use std::hint::black_box;

/// A large mesh, then `faces` faces with and without normals in turn: each starts a mesh of its own.
fn alternating_normals(faces: usize) -> String {
    let mut text = String::from("vn 0 0 1\n");
    for i in 0..faces {
        let _ = writeln!(text, "v {i} 0 0\nv {i} 1 0\nv {i} 0 1\nf -3 -2 -1");
    }
    for i in 0..faces {
        text.push_str(if i % 2 == 0 { "f 1//1 2//1 3//1\n" } else { "f 1 2 3\n" });
    }
    text
}

/// `faces` faces, each of a material of its own, in a library that is named as often.
fn many_materials(faces: usize) -> [String; 2] {
    let (mut obj, mut library) = (String::from("v 0 0 0\nv 1 0 0\nv 0 1 0\n"), String::new());
    for i in 0..faces {
        let _ = writeln!(obj, "mtllib bench.mtl\nusemtl m{i}\nf 1 2 3");
        let _ = writeln!(library, "newmtl m{i}\nKd 0.5 0.5 0.5");
    }
    [obj, library]
}

fn files(c: &mut Criterion) {
    let folder = std::env::temp_dir().join(format!("bakelite-bench-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder");
    let mut group = c.benchmark_group("files");
    group.sample_size(10);
    for faces in [10_000, 20_000, 40_000] {
        group.throughput(Throughput::Elements(faces as u64));
        let path = folder.join("bench.obj");
        let mut measure = |name: &str| {
            group.bench_with_input(BenchmarkId::new(name, faces), &path, |b, path| {
                b.iter(|| {
                    let mut data = SceneData::new();
                    black_box(bakelite::io::load(path, &mut data).expect("a valid file"))
                });
            });
        };
        std::fs::write(&path, alternating_normals(faces)).expect("a file");
        measure("obj_alternating_normals");
        let [obj, library] = many_materials(faces);
        std::fs::write(&path, obj).expect("a file");
        std::fs::write(folder.join("bench.mtl"), library).expect("a file");
        measure("obj_many_materials");
    }
    group.finish();
    let _ = std::fs::remove_dir_all(&folder);
}

criterion_group!(benches, files);
criterion_main!(benches);
