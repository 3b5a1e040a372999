//! Cases of `bakelite report stability` about shapes: how large, where, how thin.

use super::lab::{Case, Lab, Row, Texel, Verdict, deviation, diffuse, largest, mean, small_bake, small_desc, texels};
use bakelite::lightmap::{BakeParams, Layer, LightmapDesc};
use bakelite::scene::builtin;
use bakelite::scene::shapes::MeshBuilder;
use bakelite::{Light, Material, Mesh, Result, SceneData};
use glam::{DQuat, DVec3, Vec3};

pub const CASES: [(&str, Case); 10] = [
    ("scale", scale),
    ("offset", offset),
    ("sealed box", sealed_box),
    ("thin wall", thin_wall),
    ("two-sided sheet", sheet),
    ("slivers", slivers),
    ("coplanar duplicates", duplicates),
    ("small charts", small_charts),
    ("shadow terminator", terminator),
    ("closed corners", closed_corners),
];

/// The scene turned, scaled and moved. Intensities of point lights follow the square of the scale, so that
/// irradiance stays as it was.
fn transformed(data: &SceneData, turn: DQuat, scale: f64, offset: DVec3) -> Result<SceneData> {
    let place = |p: Vec3| (turn * p.as_dvec3() * scale + offset).as_vec3();
    let edge = |e: Vec3| (turn * e.as_dvec3() * scale).as_vec3();
    let mut out = SceneData::new();
    for m in data.materials() {
        out.add_material(*m)?;
    }
    for mesh in data.meshes() {
        let positions = mesh.positions.iter().map(|&p| place(p)).collect();
        out.add_mesh(Mesh { positions, ..mesh.clone() })?;
    }
    for &light in data.lights() {
        out.add_light(match light {
            Light::Point { position, intensity } => Light::Point {
                position: place(position),
                intensity: intensity.map(|i| (i as f64 * scale * scale) as f32),
            },
            Light::Rect { position, edge_u, edge_v, radiance } => {
                Light::Rect { position: place(position), edge_u: edge(edge_u), edge_v: edge(edge_v), radiance }
            }
            other => other,
        })?;
    }
    Ok(out)
}

/// The same picture at every scale; the same bits if the scale is a power of two.
fn scale(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    let cornell = builtin("cornell")?;
    let bake = |scale: f64| -> Result<Vec<Texel>> {
        let data = transformed(&cornell, DQuat::IDENTITY, scale, DVec3::ZERO)?;
        texels(&lab.baked(data, &small_desc(), &small_bake())?, Layer::Combined)
    };
    let one = bake(1.0)?;
    for power in lab.some(&[-9, -6, -4, -2, 2, 4, 6, 9]) {
        let got = bake(10f64.powi(power))?;
        let row = Row::new("scale", format!("1e{power}"), 10f64.powi(power), mean(&one), mean(&got));
        rows.push(row.within(1e-3).note(format!("mean; {} texels, {} at scale 1", got.len(), one.len())));
    }
    for power in lab.some(&[-30, -20, 20, 30]) {
        let factor = 2f64.powi(power);
        let got = bake(factor)?;
        let different =
            one.iter().zip(&got).filter(|(a, b)| a.value != b.value).count() + got.len().abs_diff(one.len());
        let row = Row::of_error("scale", format!("2^{power}"), factor, different as f64 / one.len() as f64);
        rows.push(row.within(0.0).note("part of the texels that have other bits"));
    }
    Ok(())
}

/// Far from the origin f32 positions lose digits: right while there are enough, after that with a warning.
fn offset(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    let cornell = builtin("cornell")?;
    let size = 5.5;
    let bake = |offset: f64| -> Result<Vec<Texel>> {
        let data = transformed(&cornell, DQuat::IDENTITY, 1.0, DVec3::splat(offset * size))?;
        texels(&lab.baked(data, &small_desc(), &small_bake())?, Layer::Combined)
    };
    let one = bake(0.0)?;
    for times in lab.some(&[1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7]) {
        lab.take_warnings();
        let got = bake(times);
        let warnings = lab.take_warnings();
        let told = warnings.iter().any(|w| w.contains("digits"));
        rows.push(match got {
            Ok(got) => {
                let row = Row::new("offset", format!("{times:e}"), times, mean(&one), mean(&got)).within(0.01);
                row.or_degrades(told).note(warnings.first().cloned().unwrap_or("no warning".into()))
            }
            Err(e) => Row::refusal::<()>("offset", format!("{times:e}"), Err(e), "degenerate"),
        });
    }
    Ok(())
}

/// No light enters a closed box.
fn sealed_box(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    let map = lab.baked(builtin("sealed")?, &small_desc(), &small_bake())?;
    let inside = map.scene().first_triangle(1)..map.scene().first_triangle(2);
    let all = texels(&map, Layer::Combined)?;
    let dark: Vec<Texel> = all.iter().filter(|t| inside.contains(&t.triangle)).copied().collect();
    let note = format!("{} texels inside, room {:.3}", dark.len(), mean(&all));
    rows.push(Row::of_error("sealed box", "", 0.0, largest(&dark)).within(0.0).note(note));
    Ok(())
}

/// Two closed rooms of 1 x 1 x 1 with a gap between them, the first lit.
fn two_rooms(gap: f32, turn: DQuat) -> Result<SceneData> {
    let mut data = SceneData::new();
    let white = data.add_material(diffuse(0.7))?;
    for x in [0.0, 1.0 + gap] {
        let mut cube = MeshBuilder::new();
        cube.box_(Vec3::X * x, Vec3::new(x + 1.0, 1.0, 1.0), true, white);
        data.add_mesh(cube.finish())?;
    }
    data.add_light(Light::Point { position: Vec3::new(0.6, 0.5, 0.45), intensity: [1.0; 3] })?;
    transformed(&data, turn, 1.0, DVec3::ZERO)
}

fn push_dark(
    lab: &Lab,
    rows: &mut Vec<Row>,
    case: &'static str,
    parameter: String,
    radius: f32,
    data: SceneData,
) -> Result<()> {
    let map = lab.baked(data, &small_desc(), &BakeParams { radius, ..small_bake() })?;
    let dark = map.scene().first_triangle(1);
    for (name, layer) in [("direct", Layer::Direct), ("indirect", Layer::Indirect)] {
        let all = texels(&map, layer)?;
        let (dark, lit): (Vec<Texel>, Vec<Texel>) = all.iter().partition(|t| t.triangle >= dark);
        let error = largest(&dark) / mean(&lit);
        let wrong = dark.iter().filter(|t| t.value != Vec3::ZERO).count();
        let note = format!("{wrong} of {} texels of the dark room are lit", dark.len());
        rows.push(Row::of_error(case, format!("{parameter}, {name}"), 0.0, error).within(0.0).note(note));
    }
    Ok(())
}

/// A dark room beside a lit one stays dark.
fn thin_wall(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    for gap in lab.some(&[1e-1f32, 1e-2, 1e-3, 1e-4, 2e-5, 1e-6, 0.0]) {
        push_dark(lab, rows, "thin wall", format!("{gap:e}"), 0.0, two_rooms(gap, DQuat::IDENTITY)?)?;
    }
    // Discs of the photon map's estimate that reach across the wall.
    for radius in lab.some(&[0.1, 0.3]) {
        for gap in [1e-3, 0.0] {
            let parameter = format!("{gap:e}, search radius {radius}");
            push_dark(lab, rows, "thin wall", parameter, radius, two_rooms(gap, DQuat::IDENTITY)?)?;
        }
    }
    Ok(())
}

/// The same where edges lie in no axis, and rounding opens what it can.
fn closed_corners(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    for i in lab.some(&[1, 2, 3]) {
        let turn = DQuat::from_scaled_axis(DVec3::new(0.3, 0.7, -0.2) * i as f64);
        push_dark(lab, rows, "closed corners", format!("turn {i}"), 0.0, two_rooms(0.01, turn)?)?;
    }
    Ok(())
}

/// A two-sided sheet divides a room: light above, none below. Each side has its own light in what gather rays see.
fn sheet(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    let mut data = SceneData::new();
    let white = data.add_material(diffuse(0.7))?;
    let both = data.add_material(Material { two_sided: true, ..diffuse(0.7) })?;
    let mut upper = MeshBuilder::new();
    upper.box_(Vec3::new(0.0, 0.5, 0.0), Vec3::ONE, true, white);
    let mut mesh = upper.finish();
    // Without the upper half's floor, which the sheet is.
    let flat = |m: &Mesh, t: &[u32; 3], y: f32| t.iter().all(|&i| m.positions[i as usize].y == y);
    let open = |mut m: Mesh, y: f32| {
        m.indices = m.indices.iter().filter(|t| !flat(&m, t, y)).copied().collect();
        m.materials = bakelite::scene::MeshMaterials::One(white);
        m
    };
    mesh = open(mesh, 0.5);
    data.add_mesh(mesh)?;
    let mut plane = MeshBuilder::new();
    plane.quad(Vec3::Y * 0.5, Vec3::new(0.0, 0.5, 1.0), Vec3::new(1.0, 0.5, 1.0), Vec3::new(1.0, 0.5, 0.0), both);
    data.add_mesh(plane.finish())?;
    let mut lower = MeshBuilder::new();
    lower.box_(Vec3::ZERO, Vec3::new(1.0, 0.5, 1.0), true, white);
    data.add_mesh(open(lower.finish(), 0.5))?;
    data.add_light(Light::Point { position: Vec3::new(0.5, 0.8, 0.5), intensity: [1.0; 3] })?;
    let map = lab.baked(data, &small_desc(), &small_bake())?;
    let lower = map.scene().first_triangle(2);
    for (name, layer) in [("direct", Layer::Direct), ("indirect", Layer::Indirect)] {
        let all = texels(&map, layer)?;
        let (dark, lit): (Vec<Texel>, Vec<Texel>) = all.iter().partition(|t| t.triangle >= lower);
        let row = Row::of_error("two-sided sheet", name, 0.0, largest(&dark) / mean(&lit)).within(0.0);
        rows.push(row.note("light below the sheet, by that above"));
    }
    Ok(())
}

/// A floor with 2n slivers of width 1/n in its middle has the light of a whole one.
fn slivers(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    for width in lab.some(&[1e-3f32, 1e-4, 1e-5, 1e-6]) {
        const SLIVERS: usize = 32;
        let bake = |cut: bool| -> Result<Vec<Texel>> {
            let mut data = SceneData::new();
            let white = data.add_material(diffuse(0.7))?;
            let mut room = MeshBuilder::new();
            let mut columns = vec![0.0, 1.0];
            if cut {
                columns.splice(1..1, (0..=SLIVERS).map(|i| 0.5 + width * i as f32));
            }
            for c in columns.windows(2) {
                let at = |x: f32, z: f32| Vec3::new(x, 0.0, z);
                room.quad(at(c[0], 0.0), at(c[0], 1.0), at(c[1], 1.0), at(c[1], 0.0), white);
            }
            data.add_mesh(room.finish())?;
            let mut wall = MeshBuilder::new();
            wall.quad(Vec3::ZERO, Vec3::Y, Vec3::new(0.0, 1.0, 1.0), Vec3::Z, white);
            let mut wall = wall.finish();
            wall.indices.iter_mut().for_each(|t| t.swap(1, 2));
            data.add_mesh(wall)?;
            data.add_light(Light::Point { position: Vec3::new(0.5, 0.5, 0.5), intensity: [1.0; 3] })?;
            texels(
                &lab.baked(data, &LightmapDesc { texels_per_unit: 40.0, ..small_desc() }, &small_bake())?,
                Layer::Combined,
            )
        };
        let (whole, cut) = (bake(false)?, bake(true)?);
        let floor = |t: &[Texel]| t.iter().filter(|t| t.position.y == 0.0).copied().collect::<Vec<_>>();
        let (whole, cut) = (floor(&whole), floor(&cut));
        // To the nearest texel of the whole floor.
        let expected = |t: &Texel| {
            let near = whole.iter().min_by(|a, b| {
                a.position.distance_squared(t.position).total_cmp(&b.position.distance_squared(t.position))
            });
            near.map_or(f64::NAN, |n| n.value.x as f64)
        };
        let error = deviation(&cut, expected);
        let row = Row::of_error("slivers", format!("1:{:.0e}", 1.0 / width), width as f64, error);
        rows.push(row.within(0.05).note(format!("{} texels against {}", cut.len(), whole.len())));
    }
    Ok(())
}

/// Faces that are there twice have the light of one.
fn duplicates(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    let bake = |copies: usize| -> Result<Vec<Texel>> {
        let cornell = builtin("cornell")?;
        let mut data = SceneData::new();
        for m in cornell.materials() {
            data.add_material(*m)?;
        }
        for mesh in cornell.meshes() {
            for _ in 0..copies {
                data.add_mesh(mesh.clone())?;
            }
        }
        data.add_light(cornell.lights()[0])?;
        let desc = LightmapDesc { texels_per_unit: 12.0, page_size: 256, ..small_desc() };
        texels(&lab.baked(data, &desc, &small_bake())?, Layer::Combined)
    };
    let (one, two) = (bake(1)?, bake(2)?);
    let row = Row::new("coplanar duplicates", "all twice", 2.0, mean(&one), mean(&two)).within(0.01);
    rows.push(row.note(format!("{} texels, {} of one copy", two.len(), one.len())));
    Ok(())
}

/// Texels lie on their triangles and have their light, however small charts are for them.
fn small_charts(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    for size in lab.some(&[1.0f32, 0.1, 0.01, 1e-3, 1e-5]) {
        let mut data = SceneData::new();
        let grey = data.add_material(diffuse(0.5))?;
        for i in 0..16 {
            let a = Vec3::new(i as f32 * 1.3, 0.0, 0.37 * (i % 5) as f32);
            let mut mesh = MeshBuilder::new();
            mesh.triangle(a, a + Vec3::new(0.2, 0.0, 1.0) * size, a + Vec3::new(1.0, 0.0, 0.1) * size, grey);
            data.add_mesh(mesh.finish())?;
        }
        let position = Vec3::new(8.0, 5.0, 1.0);
        data.add_light(Light::Point { position, intensity: [100.0; 3] })?;
        let desc = LightmapDesc { texels_per_unit: 7.0, page_size: 256, ..small_desc() };
        let map = lab.baked(data, &desc, &small_bake())?;
        let all = texels(&map, Layer::Combined)?;
        let off =
            all.iter().map(|t| distance_to_triangle(t.position, map.scene().corners(t.triangle))).fold(0.0, f64::max);
        let error = deviation(&all, |t| {
            let way = (position - t.position).as_dvec3();
            100.0 * way.y / way.length().powi(3)
        });
        let parameter = format!("{} texels a side", size * 7.0);
        let name = "small charts";
        rows.push(
            Row::of_error(name, &parameter, size as f64, error).within(1e-3).note(format!("{} texels", all.len())),
        );
        rows.push(
            Row::of_error(name, parameter, size as f64, off).within(1e-5).note("farthest sample from its triangle"),
        );
    }
    Ok(())
}

/// How far outside of its triangle's edges a point in its plane lies.
fn distance_to_triangle(p: Vec3, corners: [Vec3; 3]) -> f64 {
    let [a, b, c] = corners.map(|c| c.as_dvec3());
    let normal = (b - a).cross(c - a).normalize();
    let p = p.as_dvec3();
    let beyond = |from: DVec3, to: DVec3| (p - from).dot((to - from).cross(normal).normalize());
    beyond(a, b).max(beyond(b, c)).max(beyond(c, a)).max((p - a).dot(normal).abs()).max(0.0)
}

/// A coarse sphere with smooth normals under a point light against the fine sphere: the light of the place
/// with the same normal.
fn terminator(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    for subdivisions in lab.some(&[1, 2, 3, 4]) {
        let mut data = SceneData::new();
        let grey = data.add_material(diffuse(0.5))?;
        let mut sphere = MeshBuilder::new();
        sphere.sphere(Vec3::ZERO, 1.0, subdivisions, grey);
        let mut mesh = sphere.finish();
        mesh.normals = mesh.positions.iter().map(|p| p.normalize()).collect();
        data.add_mesh(mesh)?;
        let light = Vec3::new(3.0, 4.0, 2.0);
        data.add_light(Light::Point { position: light, intensity: [29.0; 3] })?;
        let params = BakeParams { gather_rays: 0, ..small_bake() };
        let all = texels(&lab.baked(data, &small_desc(), &params)?, Layer::Direct)?;
        let expected = |t: &Texel| {
            let way = (light - t.normal).as_dvec3();
            29.0 * way.dot(t.normal.as_dvec3()).max(0.0) / way.length().powi(3)
        };
        let black = all.iter().filter(|t| t.value.x == 0.0 && expected(t) > 0.05).count();
        let triangles = 20 * 4u32.pow(subdivisions);
        let row = Row::of_error(
            "shadow terminator",
            format!("{triangles} triangles"),
            triangles as f64,
            deviation(&all, expected),
        );
        // A texel on the flat triangle is not where the sphere is: of 80 triangles, up to a tenth of the radius.
        let tolerance = [f64::NAN, 0.06, 0.03, 0.015, 0.01][subdivisions as usize];
        let row = row.within(tolerance).note(format!("{black} of {} texels are black and should not be", all.len()));
        rows.push(if black > 0 { Row { verdict: Verdict::Fails, ..row } } else { row });
    }
    Ok(())
}
