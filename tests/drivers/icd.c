// An OpenCL driver for tests: with -DCRASHES or -DHANGS it does that when it is asked for its platforms, else it lists one
// device on which no program builds; with -DCRASHES_IN_BUILD it crashes there.
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define REFUSED (-59)  // CL_INVALID_OPERATION

static int32_t refuse(void) { return REFUSED; }

static void *dispatch[256];
static struct object {
  void **dispatch;
} platform = {dispatch}, device = {dispatch}, context = {dispatch}, queue = {dispatch}, program = {dispatch};

static int32_t give(const void *value, size_t size, size_t capacity, void *out, size_t *needed) {
  if (out) memcpy(out, value, size < capacity ? size : capacity);
  if (needed) *needed = size;
  return 0;
}

static int32_t give_text(const char *text, size_t capacity, void *out, size_t *needed) {
  return give(text, strlen(text) + 1, capacity, out, needed);
}

int32_t clGetPlatformInfo(struct object *of, uint32_t what, size_t capacity, void *out, size_t *needed) {
  const char *texts[] = {"FULL_PROFILE", "OpenCL 1.2", "Broken", "tests", "cl_khr_icd"};
  return give_text(what == 0x0920 ? "tests" : texts[what - 0x0900], capacity, out, needed);
}

static int32_t get_devices(struct object *of, uint64_t kind, uint32_t capacity, struct object **out, uint32_t *count) {
  if (out) *out = &device;
  if (count) *count = 1;
  return 0;
}

static int32_t get_device_info(struct object *of, uint32_t what, size_t capacity, void *out, size_t *needed) {
  const char *texts[] = {"unbuilding", "tests", "1", "FULL_PROFILE", "OpenCL 1.2", "cl_khr_icd"};
  struct object *own = &platform;
  uint64_t number = what == 0x1000 ? 2 : 1 << 20;  // its type is a CPU
  if (what >= 0x102B && what <= 0x1030) return give_text(texts[what - 0x102B], capacity, out, needed);
  if (what == 0x1031) return give(&own, sizeof own, capacity, out, needed);
  return give(&number, capacity && capacity < 8 ? capacity : 8, capacity, out, needed);
}

static struct object *create_context(void *p, uint32_t n, void *d, void *f, void *u, int32_t *status) {
  if (status) *status = 0;
  return &context;
}

static int32_t get_context_info(struct object *of, uint32_t what, size_t capacity, void *out, size_t *needed) {
  struct object *only = &device;
  return give(&only, sizeof only, capacity, out, needed);
}

static struct object *create_queue(struct object *of, void *d, uint64_t p, int32_t *status) {
  if (status) *status = 0;
  return &queue;
}

static struct object *create_program(struct object *of, uint32_t n, void *s, void *l, int32_t *status) {
  if (status) *status = 0;
  return &program;
}

static int32_t keep(void *object) { return 0; }

static int32_t build(void) {
#ifdef CRASHES_IN_BUILD
  abort();
#endif
  return -11;  // CL_BUILD_PROGRAM_FAILURE
}

static int32_t get_build_info(struct object *of, void *d, uint32_t what, size_t capacity, void *out, size_t *needed) {
  int32_t status = -2;
  if (what == 0x1181) return give(&status, sizeof status, capacity, out, needed);
  return give_text("unknown target CPU", capacity, out, needed);
}

int32_t clIcdGetPlatformIDsKHR(uint32_t capacity, struct object **out, uint32_t *count) {
#ifdef CRASHES
  abort();
#endif
#ifdef HANGS
  sleep(3600);
#endif
  for (int i = 0; i < 256; i++) dispatch[i] = refuse;
  // the places of the ICD's table, of which the first 34 are those of OpenCL 1.0's functions
  for (int i = 0; i < 4; i++) dispatch[(int[]){6, 7, 10, 11}[i]] = dispatch[28 + i % 2] = keep;
  dispatch[1] = clGetPlatformInfo;
  dispatch[2] = get_devices;
  dispatch[3] = get_device_info;
  dispatch[4] = create_context;
  dispatch[8] = get_context_info;
  dispatch[9] = create_queue;
  dispatch[26] = create_program;
  dispatch[30] = build;
  dispatch[33] = get_build_info;
  if (out) *out = &platform;
  if (count) *count = 1;
  return 0;
}

void *clGetExtensionFunctionAddress(const char *name) {
  return strcmp(name, "clIcdGetPlatformIDsKHR") ? NULL : (void *)clIcdGetPlatformIDsKHR;
}
