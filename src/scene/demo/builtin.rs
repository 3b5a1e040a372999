//! Scenes made by code, for tests, examples and first steps.

use super::atrium::{atrium, atrium_camera};
use super::colonnade::{colonnade, colonnade_camera};
use super::hall::{hall, hall_camera};
use super::menger::{menger, menger_camera};
use super::rooms::{furniture, furniture_camera, partition, partition_camera};
use super::shapes::MeshBuilder;
use crate::base::error::{Result, invalid_argument};
use crate::scene::SceneData;
use crate::scene::camera::Camera;
use crate::scene::light::Light;
use crate::scene::material::Material;
use glam::Vec3;
use std::str::FromStr;

/// The names that [`builtin`] knows.
pub const BUILTIN_NAMES: &[&str] = &["cornell", "furnace", "sealed", "atrium", "furniture", "partition"];

/// A built-in scene by name, with its lights. Units are metres, y is up.
///
/// - `cornell`: the Cornell box with its measured dimensions, open in front; white walls
///   (0.725, 0.71, 0.68), red on the left, green on the right. Its ceiling light is a rect light of
///   radiance (17, 12, 4) just below the ceiling. Mesh 0 is the room, 1 the short block, 2 the tall one.
/// - `furnace`: a closed unit cube seen from inside, emission 1, albedo 0.5. Everywhere the
///   irradiance is π · 1 / (1 − 0.5) = 2π.
/// - `sealed`: a closed box that hangs in a lit room. Mesh 0 is the room, 1 the inside of the box,
///   where the irradiance is exactly 0, 2 its outside, one centimetre away.
/// - `furniture`: a room with furniture 1 to 3 cm off its walls. `partition`: two rooms with a wall of 2 cm between
///   them that leaves a gap, and a lamp in one. Both for measurements of the light.
/// - `atrium`: two floors around a court, columns, arches, drapes; a rect light and a sun.
///
/// More are for measurements, and not among [`BUILTIN_NAMES`]:
///
/// - `furnace:ALBEDO`: the furnace with another albedo, at least 0 and less than 1.
/// - `slit`: a closed white room, 6 × 3 × 4, with a slit 20 cm wide across its ceiling, through which the sun shines.
/// - `hall:TRIANGLES`: a hall, 40 × 12 × 20, of about so many triangles, at least 20,000: half of them on flat walls
///   and a coffered ceiling (mesh 0), half on 18 fluted columns; four rect lights.
/// - `colonnade:TRIANGLES`: a grove of fluted columns under the sky, of about so many triangles, at least 100,000: all
///   columns are instances of one (mesh 1). `colonnade-copies:TRIANGLES`: the same, each a mesh.
/// - `menger:LEVEL`: the Menger sponge of a level up to 6 in the unit cube, two triangles for each square, in the sun;
///   `menger:LEVEL:PARTS` with PARTS² triangles in place of each.
pub fn builtin(name: &str) -> Result<SceneData> {
    match name {
        "cornell" => cornell(),
        "furnace" => furnace(0.5),
        "sealed" => sealed(),
        "atrium" => atrium(),
        "furniture" => furniture(),
        "partition" => partition(),
        "slit" => slit(),
        _ if name.starts_with("furnace:") => match name["furnace:".len()..].parse() {
            Ok(albedo) if (0.0..1.0).contains(&albedo) => furnace(albedo),
            _ => invalid_argument!("{name:?} names no albedo of a furnace from 0 to less than 1"),
        },
        _ if name.starts_with("hall:") => hall(number(name)?),
        _ if name.starts_with("colonnade:") => colonnade(number(name)?, false),
        _ if name.starts_with("colonnade-copies:") => colonnade(number(name)?, true),
        _ if name.starts_with("menger:") => {
            let (level, parts) = name["menger:".len()..].split_once(':').unwrap_or((&name["menger:".len()..], "1"));
            menger(parsed(name, level)?, parsed(name, parts)?)
        }
        _ => invalid_argument!("there is no built-in scene {name:?}; there are {}", BUILTIN_NAMES.join(", ")),
    }
}

/// The number after the colon of a name.
fn number<T: FromStr>(name: &str) -> Result<T> {
    parsed(name, name.split_once(':').map_or("", |(_, number)| number))
}

fn parsed<T: FromStr>(name: &str, number: &str) -> Result<T> {
    match number.parse() {
        Ok(number) => Ok(number),
        Err(_) => invalid_argument!("the built-in scene {name:?} has no number after its colon"),
    }
}

/// Whether [`builtin`] knows a name, those for measurements included.
pub fn is_builtin(name: &str) -> bool {
    let sized = ["furnace:", "hall:", "colonnade:", "colonnade-copies:", "menger:"];
    BUILTIN_NAMES.contains(&name) || name == "slit" || sized.iter().any(|family| name.starts_with(family))
}

/// The camera for the pictures of a built-in scene.
pub fn builtin_camera(name: &str) -> Option<Camera> {
    let looking = |position, target, fov_y| Some(Camera { position, target, up: Vec3::Y, fov_y });
    match name {
        // The original's: 25 mm of film behind 35 mm of focal length.
        "cornell" => looking(Vec3::new(2.78, 2.73, -8.0), Vec3::new(2.78, 2.73, 0.0), 2.0 * (12.5f32 / 35.0).atan()),
        _ if name.starts_with("furnace") => looking(Vec3::new(0.1, 0.5, 0.1), Vec3::new(0.6, 0.4, 0.6), 1.2),
        "sealed" => looking(Vec3::new(0.3, 2.4, 0.3), Vec3::new(2.2, 1.2, 2.2), 1.2),
        "atrium" => Some(atrium_camera()),
        "furniture" => Some(furniture_camera()),
        "partition" => Some(partition_camera()),
        _ if name.starts_with("hall:") => Some(hall_camera()),
        _ if name.starts_with("colonnade") => Some(colonnade_camera()),
        _ if name.starts_with("menger:") => Some(menger_camera()),
        "slit" => looking(Vec3::new(0.5, 1.6, 0.5), Vec3::new(3.5, 0.8, 2.5), 1.2),
        _ => None,
    }
}

fn diffuse(albedo: [f32; 3]) -> Material {
    Material { albedo, ..Default::default() }
}

/// Goral et al., *Modeling the Interaction of Light between Diffuse Surfaces* (1984), with the
/// measurements that Cornell's graphics program published, in centimetres there.
fn cornell() -> Result<SceneData> {
    let mut scene = SceneData::new();
    let white = scene.add_material(diffuse([0.725, 0.71, 0.68]))?;
    let red = scene.add_material(diffuse([0.63, 0.065, 0.05]))?;
    let green = scene.add_material(diffuse([0.14, 0.45, 0.091]))?;
    let p = |x: f32, y: f32, z: f32| Vec3::new(x, y, z) / 100.0;

    let floor = [p(552.8, 0.0, 0.0), p(0.0, 0.0, 0.0), p(0.0, 0.0, 559.2), p(549.6, 0.0, 559.2)];
    let ceiling = [p(556.0, 548.8, 0.0), p(556.0, 548.8, 559.2), p(0.0, 548.8, 559.2), p(0.0, 548.8, 0.0)];
    let mut room = MeshBuilder::new();
    let mut wall = |[a, b, c, d]: [Vec3; 4], material| room.quad(a, b, c, d, material);
    wall(floor, white);
    wall(ceiling, white);
    wall([floor[3], floor[2], ceiling[2], ceiling[1]], white);
    wall([floor[2], floor[1], ceiling[3], ceiling[2]], green);
    wall([floor[0], floor[3], ceiling[1], ceiling[0]], red);
    scene.add_mesh(room.finish())?;

    let short = [[130.0, 65.0], [82.0, 225.0], [240.0, 272.0], [290.0, 114.0]];
    let tall = [[423.0, 247.0], [265.0, 296.0], [314.0, 456.0], [472.0, 406.0]];
    for (height, plan) in [(165.0, short), (330.0, tall)] {
        // The plan is counter-clockwise from above; a hexahedron's corners 2 and 3 are the other way round.
        let corner = |i: usize| {
            let [x, z] = plan[[0, 1, 3, 2][i % 4]];
            p(x, if i < 4 { 0.0 } else { height }, z)
        };
        let mut block = MeshBuilder::new();
        block.hexahedron(std::array::from_fn(corner), false, white);
        scene.add_mesh(block.finish())?;
    }
    scene.add_light(Light::Rect {
        position: p(213.0, 548.7, 227.0),
        edge_u: p(130.0, 0.0, 0.0),
        edge_v: p(0.0, 0.0, 105.0),
        radiance: [17.0, 12.0, 4.0],
    })?;
    Ok(scene)
}

fn furnace(albedo: f32) -> Result<SceneData> {
    let mut scene = SceneData::new();
    let walls = scene.add_material(Material { emission: [1.0; 3], ..diffuse([albedo; 3]) })?;
    let mut cube = MeshBuilder::new();
    cube.box_(Vec3::ZERO, Vec3::ONE, true, walls);
    scene.add_mesh(cube.finish())?;
    Ok(scene)
}

fn slit() -> Result<SceneData> {
    let mut scene = SceneData::new();
    let white = scene.add_material(diffuse([0.7; 3]))?;
    let p = Vec3::new;
    let mut room = MeshBuilder::new();
    // The walls of the room between two values of x: floor, ceiling, front and back.
    for (x0, x1, is_open) in [(0.0, 2.9, false), (2.9, 3.1, true), (3.1, 6.0, false)] {
        room.quad(p(x0, 0.0, 0.0), p(x0, 0.0, 4.0), p(x1, 0.0, 4.0), p(x1, 0.0, 0.0), white);
        room.quad(p(x0, 0.0, 0.0), p(x1, 0.0, 0.0), p(x1, 3.0, 0.0), p(x0, 3.0, 0.0), white);
        room.quad(p(x0, 0.0, 4.0), p(x0, 3.0, 4.0), p(x1, 3.0, 4.0), p(x1, 0.0, 4.0), white);
        if !is_open {
            room.quad(p(x0, 3.0, 0.0), p(x1, 3.0, 0.0), p(x1, 3.0, 4.0), p(x0, 3.0, 4.0), white);
        }
    }
    room.quad(p(0.0, 0.0, 0.0), p(0.0, 3.0, 0.0), p(0.0, 3.0, 4.0), p(0.0, 0.0, 4.0), white);
    room.quad(p(6.0, 0.0, 0.0), p(6.0, 0.0, 4.0), p(6.0, 3.0, 4.0), p(6.0, 3.0, 0.0), white);
    scene.add_mesh(room.finish())?;
    let direction = p(0.2, -1.0, 0.1).normalize();
    scene.add_light(Light::Directional { direction, irradiance: [20.0; 3], angular_radius: 0.0 })?;
    Ok(scene)
}

fn sealed() -> Result<SceneData> {
    let mut scene = SceneData::new();
    let white = scene.add_material(diffuse([0.7; 3]))?;
    let (lower, upper) = (Vec3::new(1.5, 0.8, 1.5), Vec3::new(2.5, 1.8, 2.5));
    let wall = Vec3::splat(0.01);
    for (lower, upper, inward) in
        [(Vec3::ZERO, Vec3::new(4.0, 3.0, 4.0), true), (lower, upper, true), (lower - wall, upper + wall, false)]
    {
        let mut mesh = MeshBuilder::new();
        mesh.box_(lower, upper, inward, white);
        scene.add_mesh(mesh.finish())?;
    }
    scene.add_light(Light::Rect {
        position: Vec3::new(1.5, 2.99, 1.5),
        edge_u: Vec3::X,
        edge_v: Vec3::Z,
        radiance: [10.0; 3],
    })?;
    scene.add_light(Light::Point { position: Vec3::new(0.5, 1.3, 0.5), intensity: [3.0; 3] })?;
    Ok(scene)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::committed::Scene;
    use crate::scene::demo::shapes::enclosed_volume;
    use crate::scene::mesh::Mesh;
    use std::sync::Arc;

    fn commit(name: &str) -> Arc<Scene> {
        builtin(name).unwrap().committed()
    }

    fn assert_volume(mesh: &Mesh, expected: f64) {
        let volume = enclosed_volume(mesh).expect("the mesh is not closed");
        assert!((volume - expected).abs() < 1e-3 * expected.abs(), "{volume} m³ is not {expected} m³");
    }

    #[test]
    fn every_built_in_scene_commits_without_degenerate_triangles_and_with_light() {
        for name in BUILTIN_NAMES {
            let scene = commit(name);
            assert_eq!(scene.stats().skipped_degenerate, 0, "{name}");
            assert!(!scene.lights().is_empty() || !scene.emitters().is_empty(), "{name}");
            let camera = builtin_camera(name).unwrap();
            assert!((camera.target - camera.position).cross(camera.up).length() > 0.1, "{name}");
        }
    }

    #[test]
    fn an_unknown_name_is_refused_with_those_there_are() {
        let e = builtin("cornel").unwrap_err().to_string();
        assert!(e.contains("\"cornel\"") && e.contains("cornell, furnace"), "{e}");
        assert_eq!(builtin_camera("cornel"), None);
    }

    #[test]
    fn closed_scenes_are_closed_and_look_where_they_should() {
        assert_volume(&commit("furnace").meshes()[0], -1.0);
        let sealed = commit("sealed");
        assert_volume(&sealed.meshes()[0], -48.0);
        assert_volume(&sealed.meshes()[1], -1.0);
        assert_volume(&sealed.meshes()[2], 1.02f64.powi(3));
    }

    #[test]
    fn a_furnace_has_the_albedo_asked_for_and_the_slit_room_a_front_towards_everything() {
        assert_eq!(builtin("furnace:0.98").unwrap().materials()[0].albedo, [0.98; 3]);
        assert!(builtin("furnace:1").unwrap_err().to_string().contains("furnace:1"));
        assert!(builtin("hall:many").unwrap_err().to_string().contains("hall:many"));
        let slit = commit("slit");
        for t in 0..slit.triangle_count() {
            assert!(slit.normal(t).dot(Vec3::new(3.0, 1.5, 2.0) - slit.corners(t)[0]) > 0.5, "triangle {t}");
        }
    }

    #[test]
    fn the_cornell_box_looks_inward_and_its_blocks_outward() {
        let scene = commit("cornell");
        let [room, short, tall] = scene.meshes() else { panic!("three meshes") };
        let center = Vec3::new(2.78, 2.74, 2.8);
        for t in 0..room.indices.len() {
            assert!(scene.normal(t as u32).dot(center - room.corners(t)[0]) > 2.0, "triangle {t}");
        }
        // Plan areas by the shoelace formula from the published corners.
        assert_volume(short, 1.65 * 2.76330);
        assert_volume(tall, 3.3 * 2.76265);
        let (lower, upper) = scene.bounds();
        assert_eq!(lower, Vec3::ZERO);
        assert!((upper - Vec3::new(5.56, 5.488, 5.592)).abs().max_element() < 1e-5);
    }

    #[test]
    fn lights_shine_into_their_rooms() {
        for name in BUILTIN_NAMES {
            let scene = commit(name);
            let (lower, upper) = scene.bounds();
            for light in scene.lights().iter() {
                let Light::Rect { position, edge_u, edge_v, .. } = *light else { continue };
                let corners = [position, position + edge_u, position + edge_v, position + edge_u + edge_v];
                // The atrium's skylight lies above its open roof.
                let inside = corners.iter().all(|c| c.cmpgt(lower).all() && c.cmplt(upper).all());
                assert!(inside || *name == "atrium", "{name}");
                assert!(edge_u.cross(edge_v).dot((lower + upper) / 2.0 - position) > 0.0, "{name}");
            }
        }
    }
}
