//! Cases of `bakelite report stability` about limits: settings and scenes at and beyond the ends of their ranges.

use super::lab::{Case, Lab, Row, mean, small_bake, small_desc, texels};
use bakelite::lightmap::{BakeParams, Layer, Lightmap, LightmapDesc};
use bakelite::photon::{MAX_PHOTONS, PhotonMap, PhotonParams};
use bakelite::scene::builtin;
use bakelite::{Light, Material, Mesh, Progress, Result, SceneData};
use glam::Vec3;

pub const CASES: [(&str, Case); 4] =
    [("texels", texel_requests), ("tiny scenes", tiny_scenes), ("photon counts", photon_counts), ("radius", radii)];

/// More texels than there can be are refused before memory is taken.
fn texel_requests(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    let scene = lab.commit(builtin("cornell")?)?;
    for (texels, page_size) in [(1e9, 1024), (1e9, 16384), (1e15, 16384), (1e30, 16)] {
        let texels_per_unit = f64::sqrt(texels / 200.0) as f32;
        let desc = LightmapDesc { texels_per_unit, page_size, ..Default::default() };
        let result = Lightmap::create(&scene, &desc, &Progress::none());
        rows.push(Row::refusal("texels", format!("{texels:e}, pages of {page_size}"), result, "out of memory"));
    }
    // A density so low that everything is one texel.
    for texels_per_unit in [1e-3, 1e-30] {
        let desc = LightmapDesc { texels_per_unit, page_size: 16, ..Default::default() };
        let mut map = Lightmap::create(&scene, &desc, &Progress::none())?;
        map.bake(&small_bake(), &Progress::none())?;
        let got = mean(&super::lab::texels(&map, Layer::Combined)?);
        let row = Row::sound("texels", format!("{texels_per_unit:e} per unit"), got);
        rows.push(row.note(format!("{} texels, mean {got:.3}", map.info().texels)));
    }
    Ok(())
}

fn tiny_scenes(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    rows.push(Row::refusal("tiny scenes", "empty", lab.commit(SceneData::new()), "no triangles"));
    let one = |corners: [Vec3; 3]| -> Result<SceneData> {
        let mut data = SceneData::new();
        data.add_material(Material::default())?;
        data.add_mesh(Mesh {
            positions: corners.to_vec().into(),
            indices: vec![[0, 1, 2]].into(),
            ..Default::default()
        })?;
        data.add_light(Light::Directional { direction: Vec3::NEG_Y, irradiance: [1.0; 3], angular_radius: 0.0 })?;
        Ok(data)
    };
    let point = lab.commit(one([Vec3::ONE; 3])?);
    rows.push(Row::refusal("tiny scenes", "one triangle without area", point, "degenerate"));
    let map = lab.baked(one([Vec3::ZERO, Vec3::Z, Vec3::X])?, &small_desc(), &small_bake())?;
    let got = mean(&texels(&map, Layer::Combined)?);
    rows.push(Row::new("tiny scenes", "one triangle under the sun", 1.0, 1.0, got).within(1e-6));
    Ok(())
}

/// Mean light of the Cornell box with other parameters.
fn cornell(lab: &Lab, params: &BakeParams) -> Result<f64> {
    Ok(mean(&texels(&lab.baked(builtin("cornell")?, &small_desc(), params)?, Layer::Combined)?))
}

fn photon_counts(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    let case = "photon counts";
    let scene = lab.commit(builtin("cornell")?)?;
    let trace = |photon_count| {
        PhotonMap::trace(&scene, &PhotonParams { photon_count, ..Default::default() }, &Progress::none())
    };
    rows.push(Row::refusal(case, "map of 0", trace(0), "photon_count is 0"));
    rows.push(Row::refusal(case, "map of 2^32 + 1", trace(MAX_PHOTONS + 1), "photon_count is"));
    let twice = cornell(lab, &BakeParams { photon_count: 0, max_bounces: 1, ..small_bake() })?;
    let none = cornell(lab, &BakeParams { photon_count: 0, ..small_bake() })?;
    let row = Row::new(case, "bake with 0", 0.0, twice, none).within(0.0);
    rows.push(row.note("as with max_bounces 1: light reflected once"));
    // One photon is all light in one place, or none: only that it is sound is known.
    let one = cornell(lab, &BakeParams { photon_count: 1, ..small_bake() })?;
    rows.push(Row::sound(case, "bake with 1", one).note(format!("mean {one:.3}")));
    let count = if lab.args.params.photon_count > 1_000_000 { lab.args.params.photon_count } else { 3_000_000 };
    let params = PhotonParams { photon_count: if lab.quick { 10_000 } else { count }, ..Default::default() };
    let map = PhotonMap::trace(&scene, &params, &Progress::none())?;
    let s = map.stats();
    let note = format!(
        "{:.2e} stored, {:.2e} bytes, {:.1} s (give --photons for more)",
        s.stored as f64,
        map.bytes() as f64,
        s.trace_seconds + s.grid_seconds
    );
    let got = s.absorbed_power[0] + s.escaped_power[0];
    let row = Row::new(case, params.photon_count, params.photon_count as f64, s.emitted_power[0], got);
    rows.push(row.within(4.0 / (params.photon_count as f64).sqrt()).note(note));
    Ok(())
}

fn radii(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    let params = |radius| BakeParams { radius, ..small_bake() };
    for radius in [f32::INFINITY, f32::NAN, -1.0, 1e-40] {
        rows.push(Row::refusal("radius", format!("{radius:e}"), cornell(lab, &params(radius)), "radius is"));
    }
    let automatic = cornell(lab, &params(0.0))?;
    let none = cornell(lab, &BakeParams { photon_count: 0, ..small_bake() })?;
    for radius in lab.some(&[1e-35f32, 1e-20, 1e-6, 1e3, 1e6, 1e19, 1e37]) {
        // So small that no photon is found, or so large that the photons' light is spread over more than the scene:
        // what light reflected once leaves.
        let row = Row::new("radius", format!("{radius:e}"), radius as f64, none, cornell(lab, &params(radius))?);
        rows.push(row.within(0.01).note(format!("what is left without photons; automatic: {automatic:.4}")));
    }
    Ok(())
}
