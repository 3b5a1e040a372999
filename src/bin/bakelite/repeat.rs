//! A scene beside itself many times, as in the thesis's tables 4.1 to 4.3, which measure scenes and multiples of them.

use bakelite::scene::{Instance, MAX_TRIANGLES};
use bakelite::{Error, Result, SceneData};
use glam::{Affine3A, Vec3};

/// Adds copies of all meshes, or makes instances of them, so that the scene stands `times` times in a square grid on the
/// plane of x and z, each beside the next. Lights stay as they are. Fails if the scene has instances already.
pub fn repeat(data: &mut SceneData, times: u32, as_instances: bool) -> Result<()> {
    if !data.instances().is_empty() {
        return Err(Error::InvalidArgument("--repeat: the scene has instances already".into()));
    }
    let triangles = data.triangle_count() as u64 * u64::from(times);
    // Before copies fill the memory: they would be refused by the commit.
    if !as_instances && triangles > MAX_TRIANGLES as u64 {
        let why = format!("--repeat: {triangles} triangles of copies, more than {MAX_TRIANGLES}; try --instances");
        return Err(Error::InvalidArgument(why));
    }
    let points = || data.meshes().iter().flat_map(|mesh| mesh.positions.iter().copied());
    let (lower, upper) = (points().fold(Vec3::INFINITY, Vec3::min), points().fold(Vec3::NEG_INFINITY, Vec3::max));
    let columns = (times as f64).sqrt().ceil() as u32;
    let place = |i: u32| (upper - lower) * Vec3::new((i % columns) as f32, 0.0, (i / columns) as f32);
    for mesh in 0..data.meshes().len() as u32 {
        for i in (0..times).filter(|&i| as_instances || i > 0) {
            if as_instances {
                data.add_instance(Instance::new(mesh, Affine3A::from_translation(place(i))))?;
                continue;
            }
            let mut copy = data.meshes()[mesh as usize].clone();
            copy.positions.as_vec().iter_mut().for_each(|p| *p += place(i));
            data.add_mesh(copy)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use bakelite::scene::builtin;

    #[test]
    fn copies_and_instances_stand_in_the_same_places() {
        let once = builtin("cornell").unwrap();
        let [copies, instances] = [false, true].map(|as_instances| {
            let mut data = builtin("cornell").unwrap();
            repeat(&mut data, 5, as_instances).unwrap();
            assert_eq!(data.triangle_count(), 5 * once.triangle_count());
            let mut points: Vec<[u32; 3]> = (data.flattened().iter())
                .flat_map(|mesh| mesh.positions.iter().map(|p| p.to_array().map(f32::to_bits)).collect::<Vec<_>>())
                .collect();
            points.sort_unstable();
            points
        });
        assert!(copies == instances);
        let mut placed = builtin("colonnade:100000").unwrap();
        assert!(repeat(&mut placed, 2, false).is_err());
        let most = (MAX_TRIANGLES / once.triangle_count()) as u32;
        let e = repeat(&mut builtin("cornell").unwrap(), most + 1, false).unwrap_err();
        assert!(e.to_string().contains("try --instances"), "{e}");
    }
}
