//! Command lines as people type them, right and wrong.

use super::*;
use bakelite::Light;

fn words(line: &str) -> impl Iterator<Item = OsString> {
    line.split_whitespace().map(OsString::from)
}

fn bake(line: &str) -> Result<BakeArgs, String> {
    match parse(words(line)) {
        Ok(Command::Bake(b)) => Ok(*b),
        Ok(_) => panic!("{line}: no bake"),
        Err(e) => Err(e.to_string()),
    }
}

#[test]
fn the_flags_agree_with_each_other() {
    command().debug_assert();
}

#[test]
fn no_arguments_bake_the_atrium() {
    let b = bake("").unwrap();
    assert_eq!((b.scene.as_str(), b.scene_is_given, b.out.to_str().unwrap()), ("atrium", false, "out"));
    assert_eq!(b.formats, Formats { exr: true, exr_half: false, png: true, glb: true });
    assert_eq!(b.layers[..], LAYERS[..4]);
    assert_eq!(bake("bake").unwrap().scene, "atrium");
    assert_eq!(bake("--seed 7").unwrap().params.seed, 7);
    let density = |line: &str| bake(line).unwrap().desc.texels_per_unit;
    assert_eq!((density(""), density("--texels-per-unit 0"), density("x.obj")), (ATRIUM_DENSITY, 0.0, 0.0));
}

#[test]
fn defaults_are_those_of_the_library() {
    let b = bake("x.obj").unwrap();
    assert_eq!(b.params, BakeParams::default());
    assert_eq!(b.desc, LightmapDesc::default());
    assert_eq!(b.build, BuildOptions::default());
    assert_eq!((b.load_options().max_texture_bytes, b.load_options().max_file_bytes), {
        let own = LoadOptions::default();
        (own.max_texture_bytes, own.max_file_bytes)
    });
}

#[test]
fn scenes_of_ones_own_are_path_traced_only_if_asked() {
    let spp = |line: &str| bake(line).unwrap().reference_spp;
    assert_eq!((spp(""), spp("cornell"), spp("bake x.obj")), (BUILTIN_SPP, BUILTIN_SPP, 0));
    assert_eq!((spp("--reference-spp 0"), spp("x.obj --reference-spp 5")), (0, 5));
}

#[test]
fn a_report_takes_the_flags_of_a_bake_and_its_own() {
    let report = |line: &str| match parse(words(line)) {
        Ok(Command::ReportLive(r) | Command::ReportQuality(r)) => *r,
        _ => panic!("{line}"),
    };
    let r = report("report live --scene s.obj --photons 5 --seconds 2.5 --updates 7");
    assert_eq!((r.bake.scene.as_str(), r.bake.params.photon_count), ("s.obj", 5));
    assert_eq!((r.seconds, r.updates), (2.5, 7));
    assert_eq!(r.live, LiveParams { photon_count: 5, ..Default::default() });
    let r = report("report live --lods 2 --rounds 8 --promote 3 --cell-size 0.5 --update-rays 9 --blur 1");
    let (l, b) = (r.live, r.bake.params);
    assert_eq!((l.lod_count, l.max_rounds, l.promote_threshold, l.cell_size), (2, 8, 3, 0.5));
    assert_eq!((l.rays_per_update, l.blur, l.direct_samples), (9, 1, b.direct_samples));
    let r = report("report live");
    assert_eq!((r.bake.scene.as_str(), r.bake.desc.texels_per_unit), ("atrium", ATRIUM_DENSITY));
    assert_eq!((r.seconds, r.updates), (20.0, 10_000));
    let r = report("report quality slit --knobs radius,blur --points 7");
    assert_eq!((r.bake.scene.as_str(), r.points, r.knobs.join(" ")), ("slit", 7, "radius blur".into()));
    assert_eq!(report("report quality --knobs none").knobs.len(), 0);
    assert_eq!(report("report quality").knobs, flags::KNOBS);
    assert_eq!(bake("report.obj").unwrap().scene, "report.obj");
}

#[test]
fn every_flag_takes_hold() {
    let b = bake(
        "bake s.obj --light point:1,2,3:4,5,6 --light spot:0,0,0:0,-1,0:20,30:1,1,1 --light sun:0,-1,0:7,8,9 \
         --light sun:0,-1,0:7,8,9:90 --light sky:1,2,3 --light sky:a.HDR:2.5 \
         --light rect:0,0,0:1,0,0:0,0,1:2,2,2 --texels-per-unit 2.5 --page-size 256 --padding 3 --gather-divisor 2 \
         --radiance-divisor 16 --photons 5 --bounces 6 --gather-rays 7 --radius 0.5 --blur 8 --direct-samples 9 \
         --seed 10 --threads 2 --isa portable --bins 32 --leaf 3 --build high --compact --camera -1,1,2:3,4,5:40 --up z \
         --width 64 --height 48 --reference-spp 3 --out o --no-glb --one-side --quiet --checkpoint c \
         --checkpoint-seconds 2.5 --shard 2/3 --save-result r --load-result a --load-result b --no-stitch \
         --base-folder f --any-folder --max-texture-mb 3 --max-file-mb 4 --layers normal,direct --format png,exr-half",
    )
    .unwrap();
    assert_eq!(b.lights.len(), 7);
    assert_eq!(b.lights[0].light, Light::Point { position: Vec3::new(1.0, 2.0, 3.0), intensity: [4.0, 5.0, 6.0] });
    let Light::Directional { angular_radius, .. } = b.lights[3].light else { panic!() };
    assert!((angular_radius - std::f32::consts::FRAC_PI_2).abs() < 1e-6);
    assert_eq!((b.lights[4].light.color(), &b.lights[4].image), ([1.0, 2.0, 3.0], &None));
    assert_eq!((b.lights[5].light.color(), b.lights[5].image.as_deref()), ([2.5; 3], Some("a.HDR".as_ref())));
    assert_eq!((b.checkpoint.as_deref(), b.checkpoint_seconds), (Some("c".as_ref()), 2.5));
    assert_eq!((b.shard, b.save_result.as_deref()), (Some([1, 3]), Some("r".as_ref())));
    assert_eq!(b.load_results, [PathBuf::from("a"), PathBuf::from("b")]);
    assert_eq!((b.desc.texels_per_unit, b.desc.page_size, b.desc.padding), (2.5, 256, 3));
    assert_eq!((b.desc.gather_divisor, b.desc.radiance_divisor, b.desc.both_sides), (2, 16, false));
    let p = &b.params;
    assert_eq!((p.photon_count, p.max_bounces, p.gather_rays, p.radius, p.blur_radius), (5, 6, 7, 0.5, 8));
    assert_eq!((p.direct_samples, p.seed, p.stitch, b.threads, b.isa), (9, 10, false, 2, Some(Isa::Portable)));
    assert_eq!((b.build.bins, b.build.max_leaf, b.build.quality, b.up), (32, 3, BuildQuality::High, Vec3::Z));
    assert!(b.build.compact);
    let camera = b.camera.unwrap();
    assert_eq!((camera.position, camera.target), (Vec3::new(-1.0, 1.0, 2.0), Vec3::new(3.0, 4.0, 5.0)));
    assert!((camera.fov_y.to_degrees() - 40.0).abs() < 1e-4);
    assert_eq!((b.width, b.height, b.reference_spp), (64, 48, 3));
    assert_eq!((b.out.to_str().unwrap(), b.quiet), ("o", true));
    assert_eq!((b.base_folder, b.any_folder, b.max_texture_mb, b.max_file_mb), (Some("f".into()), true, 3, 4));
    let names: Vec<&str> = b.layers.iter().map(|l| l.name).collect();
    assert_eq!((names, b.formats.exr_half, b.formats.png), (vec!["direct", "normal"], true, true));
    assert!(!b.formats.exr && !b.formats.glb);
    assert!(!bake("--no-glb").unwrap().formats.glb && bake("--no-glb").unwrap().formats.exr);
    assert_eq!(bake("--scene s.obj").unwrap().scene, "s.obj");
    for bad in ["sky", "sky:a.png", "sky:1,2,3:4", "sky:-1,0,0", "sun:0,-1,0:7,8,9:91"] {
        assert!(bake(&format!("bake s.obj --light {bad}")).is_err(), "{bad}");
    }
    for bad in ["0/3", "4/3", "1", "1/x"] {
        assert!(bake(&format!("bake s.obj --shard {bad}")).is_err(), "{bad}");
    }
}

#[test]
fn help_and_version_are_printed_at_every_level() {
    for (line, part) in [
        ("--help", "bakelite help bake"),
        ("-h", "Usage: bakelite [bake] [SCENE]"),
        ("help bake", "[default: 1000000]"),
        ("bake --help", "--photons <N>"),
        ("report --help", "quality"),
        ("report quality --help", "--view-paths <N>"),
        ("--version", env!("CARGO_PKG_VERSION")),
    ] {
        let Err(e) = parse(words(line)) else { panic!("{line}") };
        assert_eq!(e.exit_code(), 0, "{line}");
        assert!(e.to_string().contains(part), "{line}: {e}");
    }
}

#[test]
fn errors_name_the_flag_and_the_value() {
    for (line, parts) in [
        ("bakee", &["unrecognized subcommand 'bakee'", "'bake'"][..]),
        ("repot live", &["unrecognized subcommand 'repot'", "'report'"]),
        ("bake atriun", &["'atriun' for '[SCENE]'", "neither a built-in scene (cornell,"]),
        ("--photon 5", &["'--photon'", "'--photons'"]),
        ("--nonsense", &["'--nonsense'"]),
        ("-x", &["'-x'"]),
        ("--photons", &["'--photons <N>'"]),
        ("--photons many", &["'many' for '--photons <N>'", "not a whole number"]),
        ("--photons -3", &["'-3' for '--photons <N>'", "not a whole number"]),
        ("--photons 5000000000", &["'5000000000' for '--photons <N>'", ": more than"]),
        ("--texels-per-unit dense", &["'dense' for '--texels-per-unit <F>'", "not a number"]),
        ("--texels-per-unit -1", &["'-1' for '--texels-per-unit <F>'", "not a finite number"]),
        ("--page-size 3", &["'3' for '--page-size <N>'", "outside 16 to"]),
        ("--padding 65", &["'65' for '--padding <N>'", "outside 1 to 64"]),
        ("--padding 40 --page-size 64", &["--padding 40 with --page-size 64"]),
        ("--gather-divisor 0", &["'0' for '--gather-divisor <N>'", "outside 1 to 64"]),
        ("--radius nan", &["'nan' for '--radius <F>'", "not a finite number"]),
        ("--blur 1000000", &["'1000000' for '--blur <N>'", "more than"]),
        ("--direct-samples 0", &["'0' for '--direct-samples <N>'", "outside 1 to 4096"]),
        ("--bins 1", &["'1' for '--bins <N>'", "outside 2 to 256"]),
        ("--leaf 0", &["'0' for '--leaf <N>'", "outside 1 to"]),
        ("--checkpoint-seconds -1", &["'-1' for '--checkpoint-seconds <F>'", "outside 0"]),
        ("--shard 4/3", &["'4/3' for '--shard <I/N>'", "not I/N"]),
        ("--light point:1,2:3,4,5", &["'point:1,2:3,4,5' for '--light", "the position \"1,2\" is not 3 numbers"]),
        ("--light point:1,2,3:a,4,5", &["the colour \"a,4,5\" is not 3 numbers"]),
        ("--light rect:1,2,3:1,1,1", &["there are 3 parts between colons, a rect has 5"]),
        ("--light lamp:1,2,3", &["the kind \"lamp\" is not point"]),
        ("--light sun:0,0,0:1,1,1", &["direction is zero"]),
        ("--light rect:0,0,0:1,0,0:1,0,0:1,1,1", &["no area"]),
        ("--light point:0,0,0:-1,0,0", &["less than 0"]),
        ("--isa sse9", &["'sse9' for '--isa <NAME>'", "portable, avx2, avx512, auto"]),
        ("--build hgh", &["'hgh' for '--build <NAME>'", "'high'"]),
        ("--up w", &["'w' for '--up <AXIS>'"]),
        ("--camera 1,2,3", &["for '--camera <CAMERA>'", "not position:target"]),
        ("--camera 1,2,3:1,2,3", &["not two finite points"]),
        ("--camera 0,0,0:1,2,3:200", &["field of view is 200"]),
        ("--width 0", &["0 is not in 1..=16384"]),
        ("--layers colour", &["'colour' for '--layers <A,B,..>'", "combined"]),
        ("--format jpg", &["'jpg' for '--format <A,B,..>'", "exr-half"]),
        ("--format exr,exr-half", &["--format has exr and exr-half"]),
        ("--format png --layers position", &["--layers has position"]),
        ("a.obj --scene b.obj", &["'[SCENE]' cannot be used with '--scene <SCENE>'"]),
        ("a.obj b.obj", &["'b.obj'"]),
        ("report dead", &["unrecognized subcommand 'dead'"]),
        ("report live --seconds 0", &["'0' for '--seconds <F>'", "not a finite number greater than 0"]),
        ("report live --promote 3 --rounds 2", &["--promote is 3, more than --rounds 2"]),
        ("report live --lods 5", &["5 is not in 1..=4"]),
        ("report live --updates 1.5", &["'1.5' for '--updates <N>'"]),
        ("report memory --updates 5", &["'--updates'"]),
        ("--updates 5", &["'--updates'"]),
        ("report quality --knobs photon", &["'photon' for '--knobs", "'photons'"]),
        ("report quality --points 0", &["0 is not in 1"]),
    ] {
        let Err(e) = parse(words(line)) else { panic!("{line} is taken") };
        let text = e.to_string();
        assert_eq!(e.exit_code(), 2, "{line}: {text}");
        for part in parts {
            assert!(text.contains(part), "{line}: {part} is not in {text}");
        }
    }
}

#[test]
fn live_updates_refine_by_interpolation_error_if_that_is_given() {
    let live = |line: &str| match parse(words(line)) {
        Ok(Command::ReportLive(args)) => (args.live.interpolation_error, args.live.own_rays),
        _ => panic!("{line} is no report of live updates"),
    };
    let default = LiveParams::default();
    assert_eq!(live("report live"), (default.interpolation_error, default.own_rays));
    assert_eq!(live("report live --interpolation-error 0.5 --own-rays 32"), (0.5, 32));
}
