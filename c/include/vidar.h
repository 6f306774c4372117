/* VIDAR for C and C++. Made from c/src by cbindgen: change it there (see docs/guides/c.md). */

#ifndef VIDAR_H
#define VIDAR_H

#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>

/*
 How far a state may be trusted.
 */
typedef enum {
  /*
   Metric.
   */
  VIDAR_HEALTH_OK,
  /*
   Metric, the scale's standard deviation still above two percent.
   */
  VIDAR_HEALTH_SCALE_CONVERGING,
  /*
   Lengths are not metres, or there is no state yet.
   */
  VIDAR_HEALTH_SCALE_UNKNOWN,
  /*
   Metric, few landmarks.
   */
  VIDAR_HEALTH_LOW_FEATURES,
  /*
   Propagated by the IMU alone.
   */
  VIDAR_HEALTH_DEGRADED,
  /*
   Measurements contradict the state.
   */
  VIDAR_HEALTH_SUSPECT,
  /*
   There is no state.
   */
  VIDAR_HEALTH_LOST,
} VidarHealth;

/*
 A prediction of one or more views.
 */
typedef struct VidarDepth VidarDepth;

/*
 An open network. Any number of threads may predict with it at once.
 */
typedef struct VidarDepthModel VidarDepthModel;

/*
 Why a call failed. Free it with vidar_error_free.
 */
typedef struct VidarError VidarError;

/*
 Odometry of one camera and one IMU. One thread at a time may use it.
 */
typedef struct VidarOdometry VidarOdometry;

/*
 A camera on the rig.
 */
typedef struct {
  /*
   As `--camera-model` takes it: "pinhole:fx,fy,cx,cy", "radtan:fx,fy,cx,cy,k1,k2,p1,p2", …; pixel (0, 0) is the centre of the
   top-left pixel.
   */
  const char *model;
  /*
   Columns of its images.
   */
  uint32_t width;
  /*
   Rows of its images.
   */
  uint32_t height;
  /*
   Position of the camera in the IMU's axes, metres.
   */
  double position_in_body[3];
  /*
   Orientation: maps camera axes (x right, y down, z forward) to the IMU's axes; x, y, z, w.
   */
  double body_from_camera_xyzw[4];
  /*
   t_imu - t_camera, s.
   */
  double time_offset_secs;
} VidarCamera;

/*
 Noise of an IMU in continuous time, as Kalibr and EuRoC state it.
 */
typedef struct {
  /*
   rad/s/sqrt(Hz)
   */
  double gyro_noise_density;
  /*
   rad/s^2/sqrt(Hz)
   */
  double gyro_random_walk;
  /*
   m/s^2/sqrt(Hz)
   */
  double accel_noise_density;
  /*
   m/s^3/sqrt(Hz)
   */
  double accel_random_walk;
  /*
   Hz
   */
  double rate_hz;
} VidarImuNoise;

/*
 What is known after one image.
 */
typedef struct {
  /*
   Time of the image, nanoseconds.
   */
  int64_t time_ns;
  /*
   Number of the image.
   */
  uint32_t frame;
  /*
   Counts worlds: poses of different segments cannot be compared.
   */
  uint32_t segment;
  /*
   Whether there is a state: if not, all that follows but `health` is zero.
   */
  bool is_tracking;
  /*
   Whether lengths are metres and images support the state.
   */
  bool is_metric;
  /*
   How far it may be trusted.
   */
  VidarHealth health;
  /*
   Of the body (IMU) in the world, metres; z is up.
   */
  double position_in_world[3];
  /*
   x, y, z, w.
   */
  double world_from_body_xyzw[4];
  /*
   m/s
   */
  double velocity_in_world[3];
  /*
   rad/s
   */
  double gyro_bias[3];
  /*
   m/s^2
   */
  double accel_bias[3];
  /*
   15 x 15, relative to the first pose of the segment: rotation in the body (rad), position (m), velocity (m/s), gyroscope bias,
   accelerometer bias.
   */
  double covariance[225];
  /*
   Standard deviation of ln(scale); infinite while lengths are not metres.
   */
  double scale_std;
} VidarState;

/*
 An image in the caller's memory: it is read during the call only.
 */
typedef struct {
  /*
   The first row; rows follow each other by `row_bytes`.
   */
  const uint8_t *pixels;
  /*
   Columns.
   */
  uint32_t width;
  /*
   Rows.
   */
  uint32_t height;
  /*
   Bytes of a pixel: 1 is grey, 3 is red, green, blue.
   */
  uint32_t channels;
  /*
   Bytes from one row to the next, at least `width * channels`.
   */
  size_t row_bytes;
} VidarImage;

/*
 A camera that was predicted.
 */
typedef struct {
  /*
   Position in the world, in the unit of depth.
   */
  double position_in_world[3];
  /*
   x, y, z, w; camera: x right, y down, z forward.
   */
  double world_from_camera_xyzw[4];
  /*
   fx, fy, cx, cy in pixels of the prediction; pixel (0, 0) is the centre of the top-left pixel.
   */
  double intrinsics[4];
} VidarDepthCamera;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

/*
 Its code, such as "E0310"; `vidar explain CODE` explains it. Valid until the error is freed.

 # Safety
 `error` is null or an error of this library that is not freed yet.
 */
const char *vidar_error_code(const VidarError *error);

/*
 What went wrong, in words. Valid until the error is freed.

 # Safety
 As vidar_error_code.
 */
const char *vidar_error_message(const VidarError *error);

/*
 What to do about it; null where nothing is known. Valid until the error is freed.

 # Safety
 As vidar_error_code.
 */
const char *vidar_error_hint(const VidarError *error);

/*
 Frees an error; null is allowed.

 # Safety
 `error` is null or an error of this library that is not freed yet.
 */
void vidar_error_free(VidarError *error);

/*
 An odometry, or null. `imu` may be null: poses are then up to scale. `settings` is null, or texts such as
 "odometry.max_landmarks=200" that end with a null pointer.

 # Safety
 Pointers are null or point to what is said; `error` is null or may be written to.
 */
VidarOdometry *vidar_odometry_new(const VidarCamera *camera,
                                  const VidarImuNoise *imu,
                                  const char *const *settings,
                                  VidarError **error);

/*
 Takes an IMU sample: rad/s and m/s^2 in the IMU's axes, as measured. Returns 1 if `state` (which may be null) was written: that
 after the oldest image that waited for it; 0 if none was; -1 on an error.

 # Safety
 `odometry` was made by vidar_odometry_new; `gyro` and `accel` are three numbers; others are null or may be written to.
 */
int32_t vidar_odometry_push_imu(VidarOdometry *odometry,
                                int64_t time_ns,
                                const double *gyro,
                                const double *accel,
                                VidarState *state,
                                VidarError **error);

/*
 Takes a grey image with its number and time (middle of the exposure, nanoseconds). Events come in the order of time; at equal times
 the IMU comes first. Returns as vidar_odometry_push_imu.

 # Safety
 As vidar_odometry_push_imu; `image` points to an image whose pixels are there.
 */
int32_t vidar_odometry_push_image(VidarOdometry *odometry,
                                  uint32_t frame,
                                  int64_t time_ns,
                                  const VidarImage *image,
                                  VidarState *state,
                                  VidarError **error);

/*
 After the last event: works on the images that still wait. Call it until it returns 0; 1 and -1 are as in
 vidar_odometry_push_imu.

 # Safety
 As vidar_odometry_push_imu.
 */
int32_t vidar_odometry_finish(VidarOdometry *odometry,
                              VidarState *state,
                              VidarError **error);

/*
 Frees an odometry; null is allowed.

 # Safety
 `odometry` is null or was made by vidar_odometry_new and is not freed yet.
 */
void vidar_odometry_free(VidarOdometry *odometry);

/*
 Opens a network by its name in `vidar model list`, or null. "da3-nano" is built in; nothing is fetched.

 # Safety
 `model` is null or ends in a zero byte; `error` is null or may be written to.
 */
VidarDepthModel *vidar_depth_open(const char *model,
                                  VidarError **error);

/*
 Predicts `count` images together, or null. `process_size` is the longer side of the network's input, px; 0 is the one that it was
 trained for.

 # Safety
 `model` was made by vidar_depth_open; `images` points to `count` images whose pixels are there; `error` is null or may be written to.
 */
VidarDepth *vidar_depth_predict(const VidarDepthModel *model,
                                const VidarImage *images,
                                size_t count,
                                size_t process_size,
                                VidarError **error);

/*
 Columns of the maps.

 # Safety
 `depth` was made by vidar_depth_predict.
 */
size_t vidar_depth_width(const VidarDepth *depth);

/*
 Rows of the maps.

 # Safety
 `depth` was made by vidar_depth_predict.
 */
size_t vidar_depth_height(const VidarDepth *depth);

/*
 Whether depth is in metres; else one unknown factor is common to all views.

 # Safety
 `depth` was made by vidar_depth_predict.
 */
bool vidar_depth_is_metric(const VidarDepth *depth);

/*
 z-depth of a view, row by row, or null. Valid until the prediction is freed.

 # Safety
 `depth` was made by vidar_depth_predict.
 */
const float *vidar_depth_map(const VidarDepth *depth, size_t view);

/*
 Confidence of a view, row by row: at least 1, only comparisons mean something; null for networks of single views. Valid until
 the prediction is freed.

 # Safety
 `depth` was made by vidar_depth_predict.
 */
const float *vidar_depth_confidence(const VidarDepth *depth,
                                    size_t view);

/*
 Writes the camera of a view; false where there is none.

 # Safety
 `depth` was made by vidar_depth_predict; `camera` is null or may be written to.
 */
bool vidar_depth_camera(const VidarDepth *depth, size_t view, VidarDepthCamera *camera);

/*
 Frees a prediction; null is allowed.

 # Safety
 `depth` is null or was made by vidar_depth_predict and is not freed yet.
 */
void vidar_depth_free(VidarDepth *depth);

/*
 Closes a network; null is allowed. Its predictions stay valid.

 # Safety
 `model` is null or was made by vidar_depth_open and is not closed yet.
 */
void vidar_depth_close(VidarDepthModel *model);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* VIDAR_H */
