//! A light map of two facing squares with a lamp between them, each on half of a page: what saved files are of.

use bakelite::bvh::BuildOptions;
use bakelite::lightmap::{Lightmap, LightmapDesc};
use bakelite::scene::{Light, LightmapUvs, MeshMaterials};
use bakelite::{Device, DeviceOptions, Material, Mesh, Progress, Scene, SceneData};

/// Texels on a side of the only page.
pub const PAGE: u32 = 32;

/// Not baked yet.
pub fn lightmap() -> Lightmap {
    let device = Device::new(DeviceOptions { num_threads: 1, ..Default::default() }).expect("a device");
    let mut data = SceneData::new();
    let material = data.add_material(Material { two_sided: true, ..Default::default() }).expect("a material");
    for (z, left) in [(-1.0, 0.05), (1.0, 0.55)] {
        let corners = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
        let uvs = corners.map(|[x, y]| [left + 0.4 * x, 0.05 + 0.9 * y].into()).to_vec();
        let mesh = Mesh {
            positions: corners.map(|[x, y]: [f32; 2]| [2.0 * x - 1.0, 2.0 * y - 1.0, z].into()).to_vec().into(),
            indices: vec![[0, 1, 2], [0, 2, 3]].into(),
            lightmap: Some(LightmapUvs { uvs: uvs.into(), pages: Vec::new().into() }),
            materials: MeshMaterials::One(material),
            ..Default::default()
        };
        data.add_mesh(mesh).expect("a mesh");
    }
    let lamp = Light::Point { position: [0.2, 0.1, 0.0].into(), intensity: [2.0, 1.0, 0.5] };
    data.add_light(lamp).expect("a light");
    let scene = Scene::commit(&device, data, &BuildOptions::default(), &Progress::none());
    let desc = LightmapDesc { page_size: PAGE, gather_divisor: 1, radiance_divisor: 1, ..Default::default() };
    Lightmap::create(&scene.map_err(|e| e.1).expect("a scene"), &desc, &Progress::none()).expect("a light map")
}
