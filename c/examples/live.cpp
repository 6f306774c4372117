// Odometry and depth from C++: live FOLDER, with camera.txt, imu.csv (ns, gyro, accel) and frames.txt (ns and a PGM file).
#include <cstdio>
#include <fstream>
#include <iostream>
#include <sstream>
#include <string>
#include <vector>
#include "vidar.h"

static int fail(VidarError *error) {
    std::cerr << vidar_error_code(error) << ": " << vidar_error_message(error) << "\n";
    vidar_error_free(error);
    return 1;
}

int main(int, char **argv) {
    const std::string folder = std::string(argv[1]) + "/";
    VidarError *error = nullptr;
    std::string model, file, line;
    VidarCamera camera{};
    std::ifstream calibration(folder + "camera.txt");
    calibration >> model >> camera.width >> camera.height;
    for (double &v : camera.position_in_body) calibration >> v;
    for (double &v : camera.body_from_camera_xyzw) calibration >> v;
    camera.model = model.c_str();
    const VidarImuNoise noise{1.6968e-4, 1.9393e-5, 2.0e-3, 3.0e-3, 200.0};
    const char *settings[] = {"odometry.max_landmarks=120", nullptr};
    VidarOdometry *odometry = vidar_odometry_new(&camera, &noise, settings, &error);
    if (!odometry) return fail(error);

    std::ifstream imu(folder + "imu.csv"), frames(folder + "frames.txt");
    int64_t imu_time = 0, time = 0;
    double gyro[3], accel[3];
    std::vector<uint8_t> pixels(size_t(camera.width) * camera.height);
    const VidarImage image{pixels.data(), camera.width, camera.height, 1, camera.width};
    VidarState state{};
    uint32_t metric = 0, count = 0;
    auto take = [&](int answer) { metric += answer == 1 && state.is_metric; return answer >= 0; };
    while (frames >> time >> file) {
        while (imu_time <= time && std::getline(imu, line)) {
            for (char &c : line) if (c == ',') c = ' ';
            std::istringstream row(line);
            row >> imu_time >> gyro[0] >> gyro[1] >> gyro[2] >> accel[0] >> accel[1] >> accel[2];
            if (!take(vidar_odometry_push_imu(odometry, imu_time, gyro, accel, &state, &error))) return fail(error);
        }
        std::ifstream pgm(folder + file, std::ios::binary);
        for (int i = 0; i < 3; i++) std::getline(pgm, line);  // P5, size, 255
        pgm.read(reinterpret_cast<char *>(pixels.data()), pixels.size());
        if (!take(vidar_odometry_push_image(odometry, count++, time, &image, &state, &error))) return fail(error);
    }
    while (vidar_odometry_finish(odometry, &state, &error) == 1) metric += state.is_metric;
    const double *p = state.position_in_world;
    std::printf("%u %u %.17g %.17g %.17g\n", count, metric, p[0], p[1], p[2]);
    vidar_odometry_free(odometry);

    VidarDepthModel *network = vidar_depth_open("da3-nano", &error);
    VidarDepth *depth = network ? vidar_depth_predict(network, &image, 1, 112, &error) : nullptr;
    if (!depth) return fail(error);
    const size_t width = vidar_depth_width(depth), height = vidar_depth_height(depth);
    std::printf("%zu %zu %.9g\n", width, height, vidar_depth_map(depth, 0)[height / 2 * width + width / 2]);
    vidar_depth_free(depth);
    vidar_depth_close(network);
}
