//! The texture of a mesh shows what the images show.

use crate::common::{HEIGHT, Vec3, WIDTH, camera, config, fuse, look_at, point, view};
use vidar_core::{AlignedView, Image, LieGroup, Se3, TexturedMesh, TriangleMesh};
use vidar_fusion::{FusionConfig, FusionError, TextureCamera, TextureConfig, TextureImage, texture_mesh};

/// From inside the box of half sizes 1.5 m around the origin.
fn room(o: Vec3, d: Vec3) -> Option<f64> {
    let to_wall = |a: usize| if d[a] == 0.0 { f64::INFINITY } else { (1.5 * d[a].signum() - o[a]) / d[a] };
    Some((0..3).map(to_wall).fold(f64::INFINITY, f64::min))
}

/// Tiles of 10 cm, too small for vertices 4 cm apart, each of its own colour.
fn tiles(p: Vec3) -> [u8; 3] {
    let cell = p.map(|v| (v / 0.1 + 0.5).floor() as i64);
    let hash = (cell.x * 73_856_093) ^ (cell.y * 19_349_663) ^ (cell.z * 83_492_791);
    [0, 1, 2].map(|c| 40 + ((hash >> (4 * c)) & 15) as u8 * 12)
}

/// A picture of what is coloured by `color`; every pixel the mean of nine rays.
fn picture(
    pose: &Se3,
    cast: impl Fn(Vec3, Vec3) -> Option<f64>,
    color: impl Fn(Vec3) -> [u8; 3],
) -> Image<[u8; 3]> {
    let (k, rotation) = (camera(), pose.rotation.matrix());
    Image::from_fn(WIDTH, HEIGHT, |x, y| {
        let mut sum = [0.0; 3];
        for i in 0..9 {
            let (dx, dy) = (f64::from(i % 3 - 1) / 3.0, f64::from(i / 3 - 1) / 3.0);
            let ray = rotation * k.ray(x as f64 + dx, y as f64 + dy);
            let seen = cast(pose.translation, ray).map_or([0; 3], |t| color(pose.translation + ray * t));
            (0..3).for_each(|c| sum[c] += f64::from(seen[c]) / 9.0);
        }
        sum.map(|s| s.round() as u8)
    })
}

struct Scene {
    mesh: TriangleMesh,
    cameras: Vec<TextureCamera>,
    images: Vec<TextureImage>,
}

impl Scene {
    /// A surface and its pictures, fused at 4 cm.
    fn new(
        poses: &[Se3],
        cast: impl Fn(Vec3, Vec3) -> Option<f64>,
        color: impl Fn(usize, Vec3) -> [u8; 3],
    ) -> Self {
        let mut views: Vec<AlignedView> = Vec::new();
        for (i, pose) in poses.iter().enumerate() {
            let colors = picture(pose, &cast, |p| color(i, p));
            views.push(view(i as u32, *pose, 1.0, &cast).with_color(colors).unwrap());
        }
        let mesh = fuse(&FusionConfig { voxel_size_m: 0.04, ..config() }, &views).extract_mesh();
        let cameras =
            poses.iter().map(|p| TextureCamera { world_from_camera: *p, intrinsics: camera() }).collect();
        let image = |v: &AlignedView| TextureImage {
            color: v.color().unwrap().clone(),
            depth: Some(v.depth().image().clone()),
        };
        Self { mesh, cameras, images: views.iter().map(image).collect() }
    }

    fn textured(&self, max_px: usize) -> TexturedMesh {
        let image = |i: usize| Ok::<_, FusionError>(self.images[i].clone());
        texture_mesh(&self.mesh, &self.cameras, image, &TextureConfig { max_px }).unwrap().0
    }
}

fn in_room(count: usize) -> Vec<Se3> {
    let angle = |i: usize| i as f64 / count as f64 * std::f64::consts::TAU;
    let pose = |a: f64| {
        look_at(Vec3::new(-0.3 * a.cos(), -0.3 * a.sin(), 0.1), Vec3::new(a.cos(), a.sin(), 0.1 * a.sin()))
    };
    (0..count).map(|i| pose(angle(i))).collect()
}

/// A mesh seen from a camera; colours by triangle and barycentric weights. `None` where nothing is seen.
fn rendered(
    mesh: &TriangleMesh,
    pose: &Se3,
    color: impl Fn(&[u32; 3], [f64; 3]) -> [f64; 3],
) -> Image<Option<[f64; 3]>> {
    let (k, camera_from_world) = (camera(), pose.inverse());
    let mut depth = vec![f64::INFINITY; WIDTH * HEIGHT];
    let mut out = Image::filled(WIDTH, HEIGHT, None);
    for t in &mesh.triangles {
        let corners = t.map(|i| camera_from_world * point(mesh.positions[i as usize]));
        if corners.iter().any(|c| c.z < 0.05) {
            continue;
        }
        let [a, b, c] = corners.map(|p| [k.fx * p.x / p.z + k.cx, k.fy * p.y / p.z + k.cy]);
        let area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
        let low = |i: usize| a[i].min(b[i]).min(c[i]).ceil().max(0.0) as usize;
        let high =
            |i: usize, n: usize| (a[i].max(b[i]).max(c[i]).floor() + 1.0).clamp(0.0, n as f64) as usize;
        for y in low(1)..high(1, HEIGHT) {
            for x in low(0)..high(0, WIDTH) {
                let (px, py) = (x as f64, y as f64);
                let wa = ((b[0] - px) * (c[1] - py) - (b[1] - py) * (c[0] - px)) / area;
                let wb = ((c[0] - px) * (a[1] - py) - (c[1] - py) * (a[0] - px)) / area;
                // Perspective: weights of inverse depth.
                let w = [wa / corners[0].z, wb / corners[1].z, (1.0 - wa - wb) / corners[2].z];
                let z = 1.0 / w.iter().sum::<f64>();
                if w.iter().all(|w| *w >= -1e-9) && z < depth[y * WIDTH + x] {
                    depth[y * WIDTH + x] = z;
                    out.data_mut()[y * WIDTH + x] = Some(color(t, w.map(|w| w * z)));
                }
            }
        }
    }
    out
}

fn mixed(weights: [f64; 3], of: impl Fn(usize) -> [f64; 3]) -> [f64; 3] {
    let parts = [of(0), of(1), of(2)];
    [0, 1, 2].map(|c| (0..3).map(|i| weights[i] * parts[i][c]).sum())
}

/// The texture between four texels.
fn texel(mesh: &TexturedMesh, uv: [f64; 2]) -> [f64; 3] {
    let (w, h) = (mesh.texture.width(), mesh.texture.height());
    let place = |v: f64, n: usize| (v * n as f64 - 0.5).clamp(0.0, n as f64 - 1.001);
    let (x, y) = (place(uv[0], w), place(uv[1], h));
    let (x0, y0) = (x as usize, y as usize);
    let at = |i: usize, j: usize| mesh.texture[((x0 + i).min(w - 1), (y0 + j).min(h - 1))].map(f64::from);
    let (fx, fy) = (x - x0 as f64, y - y0 as f64);
    let [a, b, c, d] = [at(0, 0), at(1, 0), at(0, 1), at(1, 1)];
    [0, 1, 2].map(|i| (a[i] * (1.0 - fx) + b[i] * fx) * (1.0 - fy) + (c[i] * (1.0 - fx) + d[i] * fx) * fy)
}

fn by_texture(mesh: &TexturedMesh, pose: &Se3) -> Image<Option<[f64; 3]>> {
    rendered(&mesh.textured, pose, |t, w| {
        let uv = mixed(w, |i| {
            let [u, v] = mesh.uvs[t[i] as usize].map(f64::from);
            [u, v, 0.0]
        });
        texel(mesh, [uv[0], uv[1]])
    })
}

/// Peak signal to noise, dB, over the pixels that are seen, which must be nearly all.
fn psnr(seen: &Image<Option<[f64; 3]>>, truth: &Image<[u8; 3]>) -> f64 {
    let pairs = seen.data().iter().zip(truth.data()).filter_map(|(s, t)| Some((s.as_ref()?, t)));
    let errors: Vec<f64> =
        pairs.flat_map(|(s, t)| [0, 1, 2].map(|c| (s[c] - f64::from(t[c])).powi(2))).collect();
    assert!(errors.len() > 3 * WIDTH * HEIGHT * 9 / 10, "{} values", errors.len());
    10.0 * (255f64.powi(2) / (errors.iter().sum::<f64>() / errors.len() as f64)).log10()
}

#[test]
fn the_texture_shows_the_images_again_and_vertices_do_not() {
    let scene = Scene::new(&in_room(12), room, |_, p| tiles(p));
    let mesh = scene.textured(8192);
    assert_eq!(mesh.textured.triangles.len() + mesh.rest.triangles.len(), scene.mesh.triangles.len());
    assert!(mesh.textured.is_consistent() && mesh.rest.is_consistent());
    assert!(mesh.uvs.iter().flatten().all(|c| (0.0..=1.0).contains(c)));
    assert!(mesh.rest.triangles.len() * 50 < scene.mesh.triangles.len(), "{}", mesh.rest.triangles.len());
    // From a place where no image was taken.
    let pose = look_at(Vec3::new(0.2, -0.1, 0.0), Vec3::new(1.5, 0.4, 0.1));
    let truth = picture(&pose, room, tiles);
    let vertices =
        rendered(&scene.mesh, &pose, |t, w| mixed(w, |i| scene.mesh.colors[t[i] as usize].map(f64::from)));
    let (textured, colored) = (psnr(&by_texture(&mesh, &pose), &truth), psnr(&vertices, &truth));
    assert!(textured > 28.0 && textured > colored + 6.0, "{textured:.1} dB, vertices {colored:.1} dB");
}

#[test]
fn a_smaller_texture_shows_less_and_stays_in_its_bounds() {
    let scene = Scene::new(&in_room(12), room, |_, p| tiles(p));
    let pose = scene.cameras[3].world_from_camera;
    let mut last = f64::INFINITY;
    for max_px in [2048, 256, 128] {
        let mesh = scene.textured(max_px);
        assert!(mesh.texture.width() <= max_px && mesh.texture.height() <= max_px);
        let quality = psnr(&by_texture(&mesh, &pose), &scene.images[3].color);
        assert!(quality < last, "{max_px}: {quality:.1} dB, larger {last:.1} dB");
        last = quality;
    }
    let image = |i: usize| Ok::<_, FusionError>(scene.images[i].clone());
    let refused = texture_mesh(&scene.mesh, &scene.cameras, image, &TextureConfig { max_px: 63 });
    assert_eq!(refused.unwrap_err(), FusionError::BadTextureSize { min: 64, max: 16_384, found: 63 });
}

#[test]
fn seams_between_images_of_other_exposure_are_levelled() {
    // Every other image is brighter by 40.
    let brighter = |i: usize, _: Vec3| if i.is_multiple_of(2) { [100; 3] } else { [140; 3] };
    let scene = Scene::new(&in_room(8), room, brighter);
    let mesh = scene.textured(8192);
    // The same place in two charts.
    let mut at: std::collections::HashMap<[u32; 3], Vec<f64>> = std::collections::HashMap::new();
    for (p, uv) in mesh.textured.positions.iter().zip(&mesh.uvs) {
        at.entry(p.map(f32::to_bits)).or_default().push(texel(&mesh, uv.map(f64::from))[0]);
    }
    let steps: Vec<f64> = at.values().filter(|c| c.len() == 2).map(|c| (c[0] - c[1]).abs()).collect();
    assert!(steps.len() > 100, "{} vertices at seams", steps.len());
    let mean = steps.iter().sum::<f64>() / steps.len() as f64;
    assert!(mean < 3.0, "{mean:.1} of 255 at seams");
    let values: Vec<f64> = at.values().flatten().copied().collect();
    let brightness = values.iter().sum::<f64>() / values.len() as f64;
    assert!((100.0..140.0).contains(&brightness), "{brightness:.0}");
}

#[test]
fn a_view_in_which_something_else_stands_in_front_is_not_asked() {
    let mut scene = Scene::new(&in_room(12), room, |_, _| [120; 3]);
    // One image is red, for someone stands in front of its camera, which is not in the map.
    scene.images[4].color = Image::filled(WIDTH, HEIGHT, [250, 0, 0]);
    scene.images[4].depth = Some(Image::filled(WIDTH, HEIGHT, 0.4));
    let red = |mesh: &TexturedMesh| {
        let is_red = |uv: &&[f32; 2]| texel(mesh, uv.map(f64::from))[1] < 60.0;
        mesh.uvs.iter().filter(is_red).count() as f64 / mesh.uvs.len() as f64
    };
    assert!(red(&scene.textured(8192)) < 0.002, "{}", red(&scene.textured(8192)));
    // Also where only its colour says so, and a view without depth is no reason to fail.
    scene.images.iter_mut().for_each(|i| i.depth = None);
    assert!(red(&scene.textured(8192)) < 0.002, "{}", red(&scene.textured(8192)));
}

#[test]
fn what_no_image_shows_keeps_the_colours_of_its_vertices() {
    let mut scene = Scene::new(&in_room(12), room, |_, p| tiles(p));
    scene.cameras.truncate(2);
    let mesh = scene.textured(8192);
    let (with, without) = (mesh.textured.triangles.len(), mesh.rest.triangles.len());
    assert!(with > 1000 && without > with, "{with} and {without}");
    assert_eq!(mesh.rest.colors.len(), mesh.rest.positions.len());
    let none = texture_mesh(
        &scene.mesh,
        &[],
        |_| -> Result<TextureImage, FusionError> { unreachable!() },
        &TextureConfig::default(),
    );
    let (none, report) = none.unwrap();
    assert_eq!((none.textured.triangles.len(), report.charts), (0, 0));
    assert_eq!(none.rest.triangles.len(), scene.mesh.triangles.len());
}

#[test]
fn any_number_of_threads_makes_the_same_texture() {
    let scene = Scene::new(&in_room(6), room, |_, p| tiles(p));
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| scene.textured(1024))
    };
    assert_eq!(with(1), with(4));
}

#[test]
fn what_does_not_fit_is_refused() {
    let scene = Scene::new(&in_room(2), room, |_, p| tiles(p));
    let small = TextureImage { color: Image::filled(10, 10, [0; 3]), depth: None };
    let image = |_: usize| Ok::<_, FusionError>(small.clone());
    let refused = texture_mesh(&scene.mesh, &scene.cameras, image, &TextureConfig::default());
    let expected = (WIDTH, HEIGHT);
    assert_eq!(refused.unwrap_err(), FusionError::ImageSize { view: 0, found: (10, 10), expected });
    let mut mesh = scene.mesh.clone();
    mesh.triangles[0][1] = u32::MAX;
    let image = |i: usize| Ok::<_, FusionError>(scene.images[i].clone());
    let refused = texture_mesh(&mesh, &scene.cameras, image, &TextureConfig::default());
    assert_eq!(refused.unwrap_err(), FusionError::BadMesh { vertices: mesh.positions.len() });
}
