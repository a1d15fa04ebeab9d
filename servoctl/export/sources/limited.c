
/* The step of a limited law is that of allocation.h. */
#define law limited_law
