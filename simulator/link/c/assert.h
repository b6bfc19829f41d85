#ifdef __cplusplus
#define DRVLINK_ASSERT(condition) static_assert(condition, #condition)
#else
#define DRVLINK_ASSERT(condition) _Static_assert(condition, #condition)
#endif

