use bakelite::lightmap::{BakeParams, Lightmap, LightmapDesc};
use bakelite::{Device, DeviceOptions, Progress, Scene, SceneData, io};

fn main() -> bakelite::Result<()> {
    let device = Device::new(DeviceOptions::default())?;
    let mut data = SceneData::new();
    io::load("scene.glb".as_ref(), &mut data)?;
    let scene = Scene::commit(&device, data, &Default::default(), &Progress::none()).map_err(|(_, error)| error)?;
    let mut map = Lightmap::create(&scene, &LightmapDesc::default(), &Progress::none())?;
    map.bake(&BakeParams::default(), &Progress::none())?;
    io::lightmaps::write_exr_pages(&map, "baked-", &Progress::none())?;
    Ok(())
}
