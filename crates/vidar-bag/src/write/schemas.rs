//! Definitions of the message types that are written, in ROS 2's interface language: a type, then those it is made of.

const HEADER: &str = "\
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
";
const QUATERNION: &str = "\
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
";
const VECTOR: &str = "\
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
";

/// The definition of a type; `None` for types that are not written.
pub(super) fn definition(name: &str) -> Option<String> {
    let (own, parts): (&str, &[&str]) = match name {
        "sensor_msgs/msg/Image" => (
            "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n",
            &[HEADER],
        ),
        "sensor_msgs/msg/Imu" => (
            "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n\
             geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n\
             geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n",
            &[HEADER, QUATERNION, VECTOR],
        ),
        "sensor_msgs/msg/CameraInfo" => (
            "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n\
             float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n",
            &[
                HEADER,
                "================================================================================\n\
                 MSG: sensor_msgs/RegionOfInterest\nuint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\n\
                 bool do_rectify\n",
            ],
        ),
        "tf2_msgs/msg/TFMessage" => (
            "geometry_msgs/TransformStamped[] transforms\n",
            &[
                "================================================================================\n\
                 MSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\n\
                 geometry_msgs/Transform transform\n",
                "================================================================================\n\
                 MSG: geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
                HEADER,
                VECTOR,
                QUATERNION,
            ],
        ),
        "nav_msgs/msg/Odometry" => (
            "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n\
             geometry_msgs/TwistWithCovariance twist\n",
            &[
                HEADER,
                "================================================================================\n\
                 MSG: geometry_msgs/PoseWithCovariance\ngeometry_msgs/Pose pose\nfloat64[36] covariance\n\
                 ================================================================================\n\
                 MSG: geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n\
                 ================================================================================\n\
                 MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n\
                 ================================================================================\n\
                 MSG: geometry_msgs/TwistWithCovariance\ngeometry_msgs/Twist twist\nfloat64[36] covariance\n\
                 ================================================================================\n\
                 MSG: geometry_msgs/Twist\ngeometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
                QUATERNION,
                VECTOR,
            ],
        ),
        _ => return None,
    };
    Some(format!("{own}{}", parts.concat()))
}
